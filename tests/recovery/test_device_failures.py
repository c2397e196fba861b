"""Devices that fail during a run: retried, reopened, asked about, and nothing lost."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from drivers.errors import DeviceBusyError, DeviceTimeoutError, DeviceUnavailableError
from drivers.interfaces import SafetyState
from service.core.records.run_events import (
    DeviceOpened,
    DeviceTrouble,
    OperatorAction,
    StepFailed,
    StepNote,
    StepRetried,
    ViewpointCaptured,
    ViewpointFailed,
)
from service.core.run.decide import AskOperator
from service.core.run.state import RunState
from tests.support.rig.bench_rig import answer, other_settings
from tests.support.runs.bench_run import PROTOCOL, VIEWS, Bench, say

LAYOUT = """\
  - id: layout
    kind: layout_check
    title: Look at the spheres
    confirm: false
    gates: [{measure: spheres_seen, min: 10}]
    recovery: {retries: 2, wait_s: 0}
"""


def test_a_camera_that_fails_twice_is_reopened_and_loses_nothing(bench: Bench) -> None:
    def fail(exposure: int) -> None:
        if exposure in (2, 3):
            raise DeviceUnavailableError("the link dropped", where="camera")

    bench.rig.shutter.on_capture = fail
    state = bench.run()
    assert state.status == "completed"
    assert bench.captured() == VIEWS
    failures = bench.payloads(ViewpointFailed)
    assert [(f.viewpoint, f.error, f.skipped) for f in failures] == [("v002", "DeviceUnavailableError", False)] * 2
    assert bench.rig.shutter.opened == 3
    assert len(bench.payloads(DeviceOpened)) == 4  # the record shows each reopening
    assert not bench.payloads(StepFailed)


@pytest.mark.parametrize("verb", ["abort", "pause"])
def test_a_wait_before_a_retry_heeds_an_abort_and_a_pause(begin: Callable[[str], Bench], verb: str) -> None:
    bench = begin(PROTOCOL.replace("recovery: {retries: 2, wait_s: 0}", "recovery: {retries: 9, wait_s: 600}"))
    waited_s: list[float] = []

    def fail(exposure: int) -> None:
        if exposure > 1:
            raise DeviceTimeoutError("no answer", where="camera")

    def wait(seconds: float) -> None:
        if not bench.payloads(StepFailed):
            return
        waited_s.append(seconds)
        if len(waited_s) == 5:
            bench.act(verb, reason="someone stepped in")
        if len(waited_s) == 10 and verb == "pause":
            bench.act("abort", reason="that is all")

    bench.rig.shutter.on_capture, bench.on_wait = fail, wait
    assert bench.run().status == "aborted"
    assert sum(waited_s) < 3
    assert not bench.payloads(StepRetried)


def test_a_camera_that_stays_away_ends_in_a_question_and_the_run_goes_on_from_there(bench: Bench) -> None:
    away = True

    def fail(exposure: int) -> None:
        if exposure > 1 and away:
            raise DeviceUnavailableError("the link dropped", where="camera")

    def plug_in(question: AskOperator, _state: RunState) -> OperatorAction:
        nonlocal away
        away = False
        assert "the link dropped" in question.text
        return answer(question, "confirm")

    bench.rig.shutter.on_capture = fail
    bench.script("capture", "recovery", plug_in)
    state = bench.run()
    assert state.status == "completed"
    assert bench.captured() == VIEWS
    assert [f.recovery for f in bench.payloads(StepFailed)] == ["retry", "retry", "ask"]
    assert {t.device for t in bench.payloads(DeviceTrouble)} == {"camera"}


def test_an_arm_whose_link_drops_is_reopened(bench: Bench) -> None:
    def drop(move: int) -> None:
        if move == 2:
            bench.rig.arm.connected = False

    bench.rig.arm.on_move = drop
    assert bench.run().status == "completed"
    assert bench.captured() == VIEWS
    assert (bench.rig.arm.opened, bench.rig.shutter.opened) == (2, 1)


def test_a_viewpoint_out_of_reach_is_given_up_and_recorded(bench: Bench) -> None:
    asked = 0

    def reachable(_T: object) -> bool:
        nonlocal asked
        asked += 1
        return asked != 2

    bench.rig.arm.reachable = reachable
    state = bench.run()
    assert state.status == "completed"
    assert bench.captured() == ["v001", "v003", "v004"]
    (failed,) = bench.payloads(ViewpointFailed)
    assert (failed.viewpoint, failed.error, failed.skipped) == ("v002", "UnreachablePoseError", True)
    assert [d.kind for d in state.deviations] == ["viewpoint_skipped"]
    assert state.steps["capture"].measures["viewpoints_given_up"] == 1


def test_a_safety_stop_asks_a_person_and_never_moves_on_by_itself(bench: Bench) -> None:
    def stop(move: int) -> None:
        if move == 2:
            bench.rig.arm.safety = SafetyState.PROTECTIVE_STOP

    def clear(question: AskOperator, _state: RunState) -> OperatorAction:
        assert "protective stop" in question.text
        assert bench.rig.arm.moves == 2
        bench.rig.arm.safety = SafetyState.NORMAL
        return answer(question, "confirm")

    bench.rig.arm.on_move = stop
    bench.script("capture", "recovery", clear)
    assert bench.run().status == "completed"
    assert [f.error for f in bench.payloads(StepFailed)] == ["SafetyStopError"]
    assert bench.captured() == VIEWS


def test_exif_that_departs_from_the_settings_fails_its_gate_until_the_image_is_taken_again(bench: Bench) -> None:
    exposures = iter(range(1, 100))
    bench.rig.shutter.exif = lambda applied: other_settings(applied) if next(exposures) == 3 else applied
    bench.script("capture", "recovery", say("confirm"))
    state = bench.run()
    assert state.status == "completed"
    question = next(q for q in bench.operator.asked if q.for_ == "recovery")
    assert "Images with wrong camera settings" in question.text
    assert bench.captured() == [*VIEWS, "v003"]
    verdicts = [c.verdicts["settings"] for c in bench.payloads(ViewpointCaptured)]
    assert verdicts == [True, True, False, True, True]


def test_a_busy_camera_is_left_alone_until_it_is_free(bench: Bench) -> None:
    def busy(exposure: int) -> None:
        if exposure in (2, 3, 4, 5, 6):
            raise DeviceBusyError("I/O in progress", where="camera")

    bench.rig.shutter.on_capture = busy
    assert bench.run().status == "completed"
    assert bench.captured() == VIEWS
    assert not bench.payloads(ViewpointFailed), "a busy camera is no failure"
    assert bench.rig.shutter.opened == 1


def test_a_photograph_by_hand_is_repeated_on_a_reopened_camera(begin: Callable[[str], Bench]) -> None:
    bench = begin(PROTOCOL.replace("  - id: capture\n", LAYOUT + "  - id: capture\n"))

    def late(exposure: int) -> None:
        if exposure == 1:
            raise DeviceTimeoutError("1 file(s) were due, came: none", where="camera")
        if exposure in (2, 3, 4):
            raise DeviceBusyError("I/O in progress", where="camera")

    def work(_what: str) -> None:
        job = bench.store.claim_job("worker 1", 30)
        if job is not None:
            bench.store.finish_job(
                job, measures={"spheres_seen": 10.0}, duration_s=1.0, result={"spheres_m": [], "details": {}}
            )

    bench.rig.shutter.on_capture, bench.operator.on_show = late, work
    state = bench.run()
    assert state.status == "completed"
    assert not bench.payloads(StepFailed)
    assert bench.rig.shutter.opened == 2
    (note,) = [note for note in bench.payloads(StepNote) if note.note == "photograph_repeated"]
    assert "came: none" in note.data["why"]
    photographs = [row for row in bench.store.artefacts(bench.run_id) if row.ref.kind == "layout_image"]
    assert len(photographs) == 1
