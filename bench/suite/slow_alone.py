"""Lists what the slow tests alone cover: what nobody notices who runs `make test` and no more.

`python -m bench.suite.slow_alone --record` runs the fast tests with coverage of all their processes, then all others,
whole runs drawn as in continuous integration (an hour on two cores), and compares them function by function. What a
process had run is lost if it is killed, so a function is counted as covered too seldom rather than too often.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import coverage

from bench.machine import REPOSITORY, RESULTS, commit, machine
from tests.support.mutants.recorder import functions

PACKAGES = ("service", "drivers", "simulators")
FAST = "not (slow or realtime or packages or whole or sweep)"
REST = "(slow or packages or whole or sweep) and not realtime"
_SETTINGS = """[run]
branch = False
parallel = True
sigterm = True
relative_files = True
patch = subprocess, fork, _exit
source = {packages}
data_file = {data}
{context}
"""


@dataclass(frozen=True, slots=True)
class Function:
    """A function, and the lines of its body that can be run."""

    file: str
    name: str
    lines: frozenset[int]


def functions_of(file: Path, lines: set[int]) -> list[Function]:
    """Return the functions of a file that have some of `lines` in their bodies, each with those."""
    name = file.relative_to(REPOSITORY).as_posix()
    own = {span: frozenset(n for n in lines if span.body <= n <= span.last) for span in functions(file)}
    return [Function(name, span.name, inside) for span, inside in own.items() if inside]


def covered(marks: str, words: Sequence[str], folder: Path, *, contexts: bool) -> coverage.CoverageData:
    """Run the tests that `marks` chooses, with coverage of all their processes, and return what they covered."""
    folder.mkdir()
    settings = folder / "coveragerc"
    context = "dynamic_context = test_function" if contexts else ""
    settings.write_text(_SETTINGS.format(packages=",".join(PACKAGES), data=folder / "data", context=context))
    run = [sys.executable, "-m", "coverage", "run", f"--rcfile={settings}", "-m", "pytest", "-q", "-m", marks, *words]
    subprocess.run(run, cwd=REPOSITORY, check=False)  # a test that fails beside coverage has covered what it has
    measured = coverage.Coverage(data_file=str(folder / "data"), config_file=str(settings))
    measured.combine()
    measured.save()
    return measured.get_data()


def _file_of_test(context: str) -> str:
    """Return the test file of a context such as `tests.web.test_pages.test_it`."""
    parts = context.split(".")
    names = [n for n, part in enumerate(parts) if part.startswith("test_")]
    return "/".join(parts[: names[0] + 1]) + ".py" if names else ""


def only_slow(fast: coverage.CoverageData, rest: coverage.CoverageData) -> dict[Function, set[str]]:
    """Return the functions of which only the other tests run anything, with those tests' files as far as known."""
    alone: dict[Function, set[str]] = {}
    for file in sorted(path for package in PACKAGES for path in (REPOSITORY / package).rglob("*.py")):
        measured = _of_file(rest, file)
        lines = set(measured)
        quick = set(_of_file(fast, file))
        for function in functions_of(file, lines | quick):
            if function.lines & lines and not function.lines & quick:
                contexts = {context for line in function.lines for context in measured.get(line, ())}
                alone[function] = {name for context in contexts if (name := _file_of_test(context))}
    return alone


def _of_file(data: coverage.CoverageData, file: Path) -> Mapping[int, list[str]]:
    name = file.relative_to(REPOSITORY).as_posix()
    return {line: data.contexts_by_lineno(name).get(line, []) for line in data.lines(name) or ()}


def page(alone: Mapping[Function, set[str]], counted: int) -> str:
    """Return the list as a page."""
    by_file: dict[str, list[Function]] = defaultdict(list)
    for function in alone:
        by_file[function.file].append(function)
    rows = [
        f"| `{file}` | {', '.join(f'`{one.name}`' for one in of_file)} | "
        f"{', '.join(sorted({test for one in of_file for test in alone[one]})) or 'a process that they start'} |"
        for file, of_file in sorted(by_file.items())
    ]
    return "\n".join([
        f"# What slow tests alone cover, {datetime.now(UTC).date().isoformat()}",
        "",
        f"`python -m bench.suite.slow_alone` at {commit()} on Python {machine()['python']}: of {counted} functions "
        f"that any test runs, {len(alone)} are run by tests outside `make test` only.",
        "",
        "| file | functions | by |",
        "|---|---|---|",
        *rows,
    ]) + "\n"  # fmt: skip


def main() -> int:
    """Run both, compare, report."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--record", action="store_true", help="write the list to bench/results")
    parser.add_argument("tests", nargs="*", default=["tests"], help="files or folders, instead of all")
    options = parser.parse_args()
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    folder = Path(tempfile.mkdtemp(prefix="slow-alone-"))
    try:
        fast = covered(FAST, options.tests, folder / "fast", contexts=False)
        rest = covered(REST, ["--draw", commit(), *options.tests], folder / "rest", contexts=True)
        alone = only_slow(fast, rest)
        counted = sum(
            len(functions_of(path, set(_of_file(fast, path)) | set(_of_file(rest, path))))
            for package in PACKAGES
            for path in (REPOSITORY / package).rglob("*.py")
        )
    finally:
        shutil.rmtree(folder)
    text = page(alone, counted)
    if options.record:
        (RESULTS / f"slow_alone-{datetime.now(UTC).date().isoformat()}.md").write_text(text, encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
