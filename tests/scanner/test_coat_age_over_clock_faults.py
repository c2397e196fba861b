"""The age of the coat and the choice of the scan, when the host reboots, sleeps, or has its clock set."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh

from service.core.records.run_events import OperatorAction, StepNote
from service.core.run.decide import AskOperator
from service.core.run.state import RunState
from service.run_start import recorded_run
from service.steps.coats import Coat, coats
from service.store.durable_effects import moment_of
from service.store.verification.verify import verify
from tests.support.record.stepped_clock import SteppedClock
from tests.support.rig.bench_rig import answer
from tests.support.runs.bench_run import Bench, bench_store, say
from tests.support.runs.computing_run import OneScanner, begin_computing_run

_LIMIT_MIN = 45.0
_BETWEEN_S = 600.0  # from the spray to the scan, of the time that passes for people
_CENTRES_MM = np.array([[60, 0, 20], [-55, 30, 35], [-50, -45, 15], [30, 55, 50], [25, -60, 30]], dtype=float)
_PROTOCOL = f"""\
id: coated
version: "1"
title: A scan of a coated specimen
spheres: {{radius_mm: 6, registration: 5, control: 0}}
camera: {{aperture_f: 22, exposure_s: 1/50, iso: 100}}
steps:
  - id: spraying
    kind: timed_application
    title: Spray
    params: {{product: Blue, sublimates_after_s: 7200, scan_within_s: 2700}}
  - id: waiting
    kind: checklist
    title: Scan the specimen
    checklist: [scanned]
    gates: [{{measure: checklist_items_open, max: 0}}]
  - id: scan
    kind: scan_import
    title: Import the scan
    params: {{spheres: 5, wait_s: 20, application: spraying}}
    gates: [{{measure: since_application_min, max: {_LIMIT_MIN:g}, unit: min}}]
    recovery: {{retries: 0}}
"""


@pytest.fixture
def rig(tmp_path: Path) -> OneScanner:
    rig = OneScanner()
    rig.folder = tmp_path / "scans"
    rig.folder.mkdir()
    return rig


@pytest.fixture
def bench(tmp_path: Path, rig: OneScanner) -> Iterator[Bench]:
    with bench_store(tmp_path / "data") as store:
        yield begin_computing_run(store, _PROTOCOL, tmp_path, rig)


def _export(rig: OneScanner, dated_s: float) -> None:
    """An export of five spheres, dated so by the host's clock or by that of the scanner's computer."""
    balls = [trimesh.creation.icosphere(3, 6.0).apply_translation(centre) for centre in _CENTRES_MM]
    path = rig.folder / "scan.ply"
    trimesh.util.concatenate(balls).export(path)
    os.utime(path, (dated_s, dated_s))


def _before_the_import(bench: Bench, happens: Callable[[], None]) -> None:
    """Let something happen before a person confirms the import, and end the run if the import does not pass."""

    def confirm(question: AskOperator, _state: RunState) -> OperatorAction:
        happens()
        return answer(question, "confirm")

    bench.script("scan", "confirm", confirm)
    bench.script("scan", "recovery", say("abort", reason="the coat is gone"))


def _nothing(_clock: SteppedClock) -> None:
    """The clocks go on."""


def _reboot(clock: SteppedClock) -> None:
    clock.reboot(off_s=300.0)


def _suspend(clock: SteppedClock) -> None:
    clock.set_utc(3600.0)  # while it sleeps, the monotonic clock stands still


def _hour_on(clock: SteppedClock) -> None:
    clock.set_utc(3600.0)


def _hour_back(clock: SteppedClock) -> None:
    clock.set_utc(-3600.0)


def _reboot_an_hour_back(clock: SteppedClock) -> None:
    clock.reboot(off_s=-3600.0)


_KNOWN = {_nothing: 10.0, _reboot: 15.0, _suspend: 70.0, _hour_on: 70.0}
_NOT_KNOWN = {_hour_back: "set back by 3600 s", _reboot_an_hour_back: "before the earlier time"}


@pytest.mark.parametrize(("fault", "minutes"), _KNOWN.items())
def test_the_coat_is_never_younger_than_it_is(
    bench: Bench, rig: OneScanner, fault: Callable[[SteppedClock], None], minutes: float
) -> None:
    def happens() -> None:
        bench.clock.passed_s += _BETWEEN_S
        fault(bench.clock)
        _export(rig, bench.clock.utc_s())

    _before_the_import(bench, happens)
    state = bench.run()
    assert state.steps["scan"].measures["since_application_min"] == pytest.approx(minutes, abs=0.2)
    assert state.status == ("completed" if minutes <= _LIMIT_MIN else "aborted")


@pytest.mark.parametrize(("fault", "why"), _NOT_KNOWN.items())
def test_an_age_that_cannot_be_known_does_not_pass(
    bench: Bench, rig: OneScanner, fault: Callable[[SteppedClock], None], why: str
) -> None:
    def happens() -> None:
        bench.clock.passed_s += _BETWEEN_S
        _export(rig, bench.clock.utc_s())  # before the fault, so that it is not left out
        fault(bench.clock)

    _before_the_import(bench, happens)
    state = bench.run()
    assert state.status == "aborted"
    assert "since_application_min" not in state.steps["scan"].measures
    (verdict,) = state.steps["scan"].verdicts
    assert (verdict.value, verdict.passed) == (None, False)
    (note,) = [note for note in bench.payloads(StepNote) if "is not known" in note.note]
    assert why in note.note
    assert note.note in bench.operator.told
    assert {note.data["applied"]["boot"], note.data["arrived"]["boot"]} <= {"boot-1", "boot-2"}


_BEFORE = "Coat of Blue: 34 min left."
_SHOWN = {
    _nothing: "Coat of Blue: 34 min left.",
    _reboot: "Coat of Blue: 29 min left.",
    _suspend: "Coat of Blue: 26 min too old.",
    _hour_on: "Coat of Blue: 26 min too old.",
    _hour_back: "Coat of Blue: how old it is cannot be known.",
    _reboot_an_hour_back: "Coat of Blue: how old it is cannot be known.",
}


@pytest.mark.parametrize(("fault", "title"), _SHOWN.items())
def test_what_the_clock_of_the_coat_shows_is_what_the_gate_judges(
    bench: Bench, rig: OneScanner, fault: Callable[[SteppedClock], None], title: str
) -> None:
    shown: list[Coat] = []

    def look() -> None:
        protocol, _root = recorded_run(bench.store, bench.run_id)
        shown.extend(coats(protocol, bench.state(), moment_of(bench.clock)))

    def happens() -> None:
        bench.clock.passed_s += _BETWEEN_S
        look()
        fault(bench.clock)
        _export(rig, bench.clock.utc_s() + 7200.0)
        look()

    _before_the_import(bench, happens)
    state = bench.run()
    before, after = shown
    assert (before.title, before.within_s, before.gated) == (_BEFORE, 60.0 * _LIMIT_MIN, True)
    assert after.title == title
    judged = state.steps["scan"].measures.get("since_application_min")
    assert (after.age.seconds is None) == (judged is None)
    if judged is not None and after.age.seconds is not None and after.left_s is not None:
        assert after.age.seconds / 60 == pytest.approx(judged, abs=0.2)
        assert (after.left_s > 0) == state.steps["scan"].gates_passed
    assert after.due_utc == "" if after.left_s is None else after.due_utc > "2026"
    look()
    assert len(shown) == 2  # the run has ended


def test_a_scan_dated_before_the_step_before_is_named(bench: Bench, rig: OneScanner) -> None:
    def happens() -> None:
        bench.clock.set_utc(-3600.0)
        _export(rig, bench.clock.utc_s())

    _before_the_import(bench, happens)
    assert bench.run().status == "aborted"
    (note,) = [note for note in bench.payloads(StepNote) if "left out" in note.note]
    assert note.data["left_out"].keys() == {"scan.ply"}
    assert note.note in bench.operator.told
    assert "left out 1 export older" in note.note


def test_the_scan_of_an_earlier_step_is_not_named_as_left_out(tmp_path: Path, rig: OneScanner) -> None:
    first = "  - {id: first, kind: scan_import, title: First scan, params: {spheres: 5, wait_s: 20}}\n"
    protocol = _PROTOCOL.replace("steps:\n", f"steps:\n{first}")
    with bench_store(tmp_path / "data") as store:
        bench = begin_computing_run(store, protocol, tmp_path, rig)

        def export(question: AskOperator, _state: RunState) -> OperatorAction:
            _export(rig, bench.clock.utc_s())
            return answer(question, "confirm")

        bench.script("first", "confirm", export)
        bench.script("scan", "recovery", say("abort", reason="no scan came"))
        assert bench.run().status == "aborted"
        assert bench.state().steps["first"].phase == "passed"
        assert not [note for note in bench.payloads(StepNote) if "left out" in note.note]


def test_times_that_run_backwards_are_a_note_of_the_audit(bench: Bench, rig: OneScanner) -> None:
    def happens() -> None:
        bench.clock.set_utc(-3600.0)
        _export(rig, bench.clock.utc_s() + 7200.0)

    assert not any("set back" in note for note in verify(bench.data).notes)
    _before_the_import(bench, happens)
    bench.run()
    report = verify(bench.data, bench.run_id)
    assert report.ok, report.first_fault
    assert any(note.startswith(bench.run_id) and "the host's clock was set back" in note for note in report.notes)
