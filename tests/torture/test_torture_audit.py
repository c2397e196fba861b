"""A sample of the evidence sweep: every change is detected with its place, or documented as undetected."""

from __future__ import annotations

import json

import pytest

from bench.torture.audit.__main__ import DOCUMENT, documented_codes, main, problems
from bench.torture.audit.tally import Tally


@pytest.fixture(scope="module")
def about(tmp_path_factory: pytest.TempPathFactory) -> dict[str, object]:
    """The result of a short sweep with a fixed seed."""
    folder = tmp_path_factory.mktemp("torture")
    words = ["--sample", "60", "--seed", "5", "--work", str(folder), "--results", str(folder / "results")]
    assert main(words) in (0, 1)
    (found,) = (folder / "results").glob("torture_audit-*.json")
    return json.loads(found.read_text())


@pytest.mark.slow
def test_what_is_altered_is_told_with_its_place_or_documented(about: dict[str, object]) -> None:
    assert about["problems"] == []


@pytest.mark.slow
def test_every_sweep_was_done_and_none_told_nothing(about: dict[str, object]) -> None:
    sweeps = about["sweeps"]
    assert isinstance(sweeps, dict)
    assert {name: sweep["done"] for name, sweep in sweeps.items()} == dict.fromkeys(sweeps, 60)
    assert len(sweeps) == 7
    kinds = about["kinds"]
    assert isinstance(kinds, dict)
    for kind in ("flip in the database", "flip in an artefact", "column edited", "database rolled back"):
        assert kinds[kind]["told"] > 0, kind


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
