"""A sample of the evidence sweep: every change is detected with its place, or documented as undetected."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.rig.rig import REPOSITORY
from tests.support.torture.audit.documented import DOCUMENT, SWEEPS, documented_codes, problems
from tests.support.torture.audit.tally import Tally

#: Kinds of change, by sweep, of which sixty always hold some that are told.
TOLD = {
    "edits": ("column edited",),
    "rollbacks": ("database rolled back",),
    "artefacts": ("flip in an artefact",),
    "database": ("flip in the database",),
}


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with the record that every sweep alters; the first one makes it."""
    return tmp_path_factory.mktemp("torture")


@pytest.mark.slow
@pytest.mark.sweep
@pytest.mark.parametrize("sweep", SWEEPS)
def test_what_is_altered_is_told_with_its_place_or_documented(sweep: str, work: Path, tmp_path: Path) -> None:
    words = ["--only", sweep, "--sample", "60", "--seed", "5", "--work", str(work), "--results", str(tmp_path)]
    command = [sys.executable, "-m", "bench.torture.audit", *words]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (found,) = tmp_path.glob("torture_audit-*.json")
    about = json.loads(found.read_text())
    assert about["problems"] == []
    assert {name: one["done"] for name, one in about["sweeps"].items()} == {sweep: 60}
    assert sum(kind["told"] for kind in about["kinds"].values()) > 0
    for kind in TOLD.get(sweep, ()):
        assert about["kinds"][kind]["told"] > 0, kind


def test_what_is_not_documented_is_a_problem_and_so_is_what_is_documented_wrongly() -> None:
    untold = Tally(number=1)
    untold.untold["events.actor"] += 1
    untold.samples["events.actor"] = "events, row 3"
    assert problems({"column edited": untold}, documented_codes(DOCUMENT.read_text()), whole=False) == [
        "events.actor is not detected, and evidence.md does not say so (events, row 3)"
    ]
    documented = {"leases.*": ("why", "what"), "events.*": ("why", "what")}
    assert problems({"column edited": untold}, documented, whole=True) == [
        "evidence.md says that leases.* is not detected, but it always was"
    ]
    assert len(problems({"flip": Tally(number=1, crashes=["byte 7: Traceback"])}, documented, whole=False)) == 1


def test_the_documentation_names_a_reason_and_an_anchor_for_everything() -> None:
    documented = documented_codes(DOCUMENT.read_text())
    assert len(documented) > 25
    assert all(why and anchor for why, anchor in documented.values())
