"""The short crash sweep: a death at every kind of point leaves no fault; a store that forgets is detected."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.support.rig.rig import REPOSITORY

pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]
FORGETFUL = """
from bench.torture.crash.__main__ import main
from bench.torture.crash.mortal import MortalFiles
MortalFiles.sync_file = lambda _self, _path: None  # a store that writes and renames, and does not sync
main()
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


def test_a_death_at_every_kind_of_point_leaves_nothing_behind(tmp_path: Path) -> None:
    status, shown = sweep(tmp_path, "--kinds")
    assert shown["faults"] == []
    assert status == 0
    assert {(row["process"], row["effect"]) for row in shown["rows"]} >= {
        *(("begin", effect) for effect in ("make_directory", "write", "sync_file", "rename", "commit")),
        *(("runner", effect) for effect in ("write", "append", "sync_file", "rename", "sync_directory", "commit")),
        *(("worker", effect) for effect in ("write", "sync_file", "rename", "sync_directory", "commit")),
        *(("web", effect) for effect in ("append", "sync_file", "commit")),
    }
    assert shown["deaths"] >= shown["planned"] - 2, "points that were hardly ever reached were not tried"
    assert {row["how"] for row in shown["rows"]} == {"kill", "power"}


def test_a_store_that_does_not_sync_its_files_shows(tmp_path: Path) -> None:
    status, shown = sweep(tmp_path, "--ways", "power", "--sample", "60", "--first-fault", code=FORGETFUL)
    assert status == 1, "sixty losses of power, and nothing was missed"
    faults = [fault for entry in shown["faults"] for fault in entry["faults"]]
    assert any("content" in fault or "missing" in fault or "bytes" in fault for fault in faults), faults
