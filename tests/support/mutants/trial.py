"""One mutation against its tests: in a copy of the tree, in a process forked after large libraries were imported."""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import pytest

from tests.support.mutants.reach import Selected
from tests.support.rig.rig import REPOSITORY

if TYPE_CHECKING:
    from tests.support.mutants.places import Mutation

# What most tests import and no mutation changes.
LIBRARIES = (
    *("numpy", "scipy.optimize", "scipy.spatial.transform", "scipy.sparse.linalg", "scipy.stats", "cv2", "pydantic"),
    *("sqlalchemy", "alembic.command", "hypothesis", "cryptography.x509", "fastapi.testclient", "trimesh", "yaml"),
    *("transitions.extensions", "jinja2", "rfc8785", "typer.testing", "structlog", "argon2", "h5py", "psutil"),
    *("pydicom", "prometheus_client", "rich.console", "schemathesis.pytest.plugin", "anyio.pytest_plugin"),
)
CPU_FACTOR, CPU_LEAST_S = 8.0, 40  # a mutation may need longer than its tests did, and is then taken for a hang
WALL_S = 900.0
#: Options that choose the tests which mutants meet: more than `make test` runs, but none of whole runs or the clock.
CHOSEN = ("-m", "not (realtime or packages or whole or sweep)", "--cpu-below", "2")
BATCHES = (3, 8)  # files of tests that are collected together at first, and next

Outcome = Literal["killed", "survived", "hung", "untested", "broken"]


@dataclass(frozen=True, slots=True)
class Verdict:
    """Holds what became of a mutation."""

    mutation: Mutation
    outcome: Outcome
    by: str  # the test that failed
    tests: tuple[str, ...]  # the files whose tests ran
    cpu_s: float


def copied_tree(target: Path, tests_of: str | None) -> Path:
    """Copy what git would commit, with its byte code; with the tests of another revision, if one is given.

    Files keep their times, by which Python knows that byte code is of them: no trial compiles what did not change.
    """
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(listed, cwd=REPOSITORY, capture_output=True, check=True).stdout.decode().split("\0")
    for name in filter(None, names):
        source = REPOSITORY / name
        if source.is_file() and not source.is_symlink():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, target / name)
    for folder in {Path(name).parent for name in names if name.endswith(".py")}:
        (target / folder / "__pycache__").mkdir()
        for compiled in (REPOSITORY / folder / "__pycache__").glob("*.pyc"):
            with contextlib.suppress(FileNotFoundError):  # other tests may run meanwhile, and compile it anew
                shutil.copy2(compiled, target / folder / "__pycache__")
    if tests_of is not None:
        shutil.rmtree(target / "tests")
        # Tests of earlier revisions import modules of bench, which lie over those of now; the record of now remains.
        wanted = ("tests", "bench", ":(exclude)bench/results", ":(exclude)bench/suite/mutants/reached.json")
        packed = subprocess.run(
            ["git", "archive", tests_of, *wanted], cwd=REPOSITORY, capture_output=True, check=True
        )
        subprocess.run(["tar", "-x", "-C", str(target)], input=packed.stdout, check=True)
    return target


def import_libraries() -> None:
    """Import them, before the first fork; no trial looks for garbage among them."""
    for name in LIBRARIES:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    gc.freeze()


_OURS = ("bench", "drivers", "service", "simulators", "tests")  # packages that are read anew, from the tree


class Trial:
    """A mutation that is being tried in a child process."""

    def __init__(self, tree: Path, mutation: Mutation, selected: Sequence[Selected]) -> None:
        self._tree, self._mutation, self._selected = tree, mutation, selected
        self._file = tree / mutation.place.file
        self._original = self._file.read_bytes()
        self._told = tree / "build" / "verdict.json"
        self._began_s = time.monotonic()
        self._forget_byte_code()
        self._told.parent.mkdir(exist_ok=True)
        self._told.unlink(missing_ok=True)
        self._file.write_text(mutation.text, encoding="utf-8")
        self.pid = os.fork()
        if self.pid == 0:
            try:
                _try(tree, selected, self._told)
            except BaseException:  # noqa: BLE001 - whatever it is, the parent's work is not this process's
                self._told.write_text(json.dumps({"why": traceback.format_exc()}))
            finally:
                os._exit(0)

    def overdue(self) -> None:
        """End it if it takes too long by the clock: it waits for something."""
        if time.monotonic() - self._began_s > WALL_S:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.pid, signal.SIGKILL)

    def ended(self, status: int, used: resource.struct_rusage) -> Verdict:
        """Put the tree back as it was, and judge."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, signal.SIGKILL)  # what the tests left
        self._file.write_bytes(self._original)
        self._forget_byte_code()
        told: dict[str, Any] = json.loads(self._told.read_text()) if self._told.exists() else {}
        by = str(told.get("by", ""))
        outcome: Outcome
        if not self._selected:
            outcome = "untested"
        elif os.WIFSIGNALED(status):
            outcome, by = "hung", by or f"signal {os.WTERMSIG(status)}"
        elif by:
            outcome = "killed"
        else:
            outcome, by = ("survived", "") if told.get("ran") else ("broken", str(told.get("why", "no test ran")))
        files = tuple(one.file for one in self._selected)
        return Verdict(self._mutation, outcome, by, files, used.ru_utime + used.ru_stime)

    def _forget_byte_code(self) -> None:
        """Byte code is known by time and size of its source, both of which a mutation may leave as they were."""
        for path in (self._file.parent / "__pycache__").glob(f"{self._file.stem}.*.pyc"):
            path.unlink()


class _Judge:
    """The plug-in: notes the first test, or file of tests, that failed, and how many ran."""

    def __init__(self) -> None:
        self.by, self.ran = "", 0

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """A file that cannot be read any more has found the mutation."""
        if report.failed:
            self.by = self.by or report.nodeid

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """So has a test that fails, also in its fixtures."""
        if report.failed:
            self.by = self.by or report.nodeid
        self.ran += report.when == "call"


def _try(tree: Path, selected: Sequence[Selected], told: Path) -> None:
    """In the child: run the tests, the cheapest files first, until one fails."""
    os.setsid()
    log = os.open(tree / "build" / "trial.log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for number in (1, 2):
        os.dup2(log, number)
    limit_s = int(CPU_LEAST_S + CPU_FACTOR * sum(one.cost_s for one in selected))
    resource.setrlimit(resource.RLIMIT_CPU, (limit_s, limit_s + 5))
    os.chdir(tree)
    os.environ |= {"PYTHONPATH": str(tree), "OPENBLAS_NUM_THREADS": "1"}
    os.environ.setdefault("ORTHOCAPTURE_RENDER_CACHE", str(REPOSITORY / "build" / "rendered"))  # one for all trees
    for name in ("PYTHONDONTWRITEBYTECODE", "PYTEST_ADDOPTS"):
        os.environ.pop(name, None)
    sys.dont_write_bytecode = False
    sys.path[:] = [str(tree), *(path for path in sys.path if Path(path or ".").resolve() != REPOSITORY)]
    for name in [name for name in sys.modules if name.partition(".")[0] in _OURS]:
        del sys.modules[name]
    judge, rest = _Judge(), list(selected)
    for size in (*BATCHES, len(rest)):
        batch, rest = rest[:size], rest[size:]
        if batch and not judge.by:
            pytest.main(
                [
                    *("-x", "-q", "--no-header", "-o", "addopts=", "--strict-markers", "--import-mode=importlib"),
                    *(
                        "-W",
                        "ignore::pytest.PytestAssertRewriteWarning",
                        "-p",
                        "no:cacheprovider",
                    ),
                    *CHOSEN,
                    *("--basetemp", str(tree / "build" / "tmp")),
                    *(argument for one in batch for argument in one.arguments),
                ],
                plugins=[judge],
            )
    told.write_text(json.dumps({"by": judge.by, "ran": judge.ran}))
    sys.stdout.flush()
