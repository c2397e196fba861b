"""The crash sweep: a death at every kind of point leaves no fault; a store that forgets is detected."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.support.rig.rig import REPOSITORY
from tests.support.runs.drawn_rows import rows_to_run

pytestmark = [
    pytest.mark.slow,
    pytest.mark.sweep,
    pytest.mark.timeout(1800),
]  # the first of them waits for the others
KINDS = [
    f"{process}/{effect}/{how}"
    for process, effects in (
        ("begin", ("make_directory", "write", "sync_file", "rename", "commit")),
        ("runner", ("write", "append", "sync_file", "rename", "sync_directory", "commit")),
        ("worker", ("write", "sync_file", "rename", "sync_directory", "commit")),
        ("web", ("append", "sync_file", "commit")),
    )
    for effect in effects
    for how in ("kill", "power")
]
FORGETFUL = """
import runpy
from tests.support.processes.mortal_files import MortalFiles
MortalFiles.sync_file = lambda _self, _path: None  # a store that writes and renames, and does not sync
runpy.run_module("bench.torture.crash", run_name="__main__")
"""


def sweep(folder: Path, *words: str, code: str = "") -> tuple[int, dict[str, Any]]:
    """Status and result of the sweep, run in a process without threads because it forks."""
    program = ["-c", code] if code else ["-m", "bench.torture.crash"]
    done = subprocess.run(
        [sys.executable, *program, *words, "--random-runs", "0", "--out", str(folder)],
        cwd=REPOSITORY, capture_output=True, text=True, check=False,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    results = list(folder.glob("*.json"))
    assert len(results) == 1, done.stdout + done.stderr
    return done.returncode, json.loads(results[0].read_text())["points"]


@pytest.fixture(scope="module")
def swept(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """One sweep over the kinds of death that are tested this time: it begins with two whole undisturbed runs."""
    return sweep(tmp_path_factory.mktemp("crash"), "--kinds", *rows_to_run(request, "kind"))[1]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_death_there_leaves_nothing_behind(swept: dict[str, Any], kind: str) -> None:
    process, effect, how = kind.split("/")
    (row,) = (r for r in swept["rows"] if (r["process"], r["effect"], r["how"]) == (process, effect, how))
    assert row["deaths"] == 1, "it did not die there"
    assert [fault for fault in swept["faults"] if fault["kind"] == kind] == []


@pytest.mark.slow
def test_a_store_that_does_not_sync_its_files_shows(tmp_path: Path) -> None:
    status, shown = sweep(tmp_path, "--ways", "power", "--sample", "60", "--first-fault", code=FORGETFUL)
    assert status == 1, "sixty losses of power, and nothing was missed"
    faults = [fault for entry in shown["faults"] for fault in entry["faults"]]
    lost = ("content", "missing", "bytes", "the event is not in the journal")  # of whichever file was hit first
    assert any(text in fault for fault in faults for text in lost), faults
