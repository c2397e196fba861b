"""A run from its first question to its end: what the runner does, records, refuses and survives."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from drivers.errors import DeviceBusyError, DeviceTimeoutError, DeviceUnavailableError
from drivers.interfaces import SafetyState
from service.core.errors import ComputeError, ConfigurationError, StoreError
from service.core.records.events import (
    ActionRefused,
    DeviceOpened,
    DeviceTrouble,
    JobEnqueued,
    JobFailed,
    OperatorAction,
    SessionStarted,
    StepFailed,
    StepNote,
    StepRetried,
    ViewpointCaptured,
    ViewpointFailed,
)
from service.core.run.decide import AskOperator
from service.core.run.state import RunState
from service.run_start import recorded_rig, recorded_run
from service.store.errors import LeaseHeldError
from service.store.records import Checkpoint
from service.store.signatures import timestamps as timestamping
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.rig.bench_rig import Answer, answer, other_settings
from tests.support.runs.bench_run import PROTOCOL, Bench, begin_run

VIEWS = ["v001", "v002", "v003", "v004"]
CALIBRATION = """\
  - id: intrinsics
    kind: calibration
    title: Calibrate
    confirm: false
    params:
      solve: [intrinsics]
      viewpoints:
        - station: station_1
          prefix: b
          arcs: [{tilt_deg: 20, azimuth_from_deg: 0, azimuth_to_deg: 0, count: 1, distance_m: 0.6}]
    gates: [{measure: rms_px, max: 0.5}]
"""
LAYOUT = """\
  - id: layout
    kind: layout_check
    title: Look at the spheres
    confirm: false
    gates: [{measure: spheres_seen, min: 10}]
    recovery: {retries: 2, wait_s: 0}
"""


def say(verb: str, **fields: object) -> Answer:
    """An answer with the step's id, checklist or signature filled in."""
    return lambda question, _state: answer(question, verb, **fields)


@pytest.fixture
def begin(tmp_path: Path) -> Iterator[Callable[[str], Bench]]:
    with Store.open(tmp_path / "data") as store:
        yield lambda text: begin_run(store, text, tmp_path)


@pytest.fixture
def bench(begin: Callable[[str], Bench]) -> Bench:
    return begin(PROTOCOL)


# --- the good day ------------------------------------------------------------------------------------------


def test_a_run_goes_from_its_checklist_through_the_captures_to_its_end(bench: Bench) -> None:
    state = bench.run()
    assert state.status == "completed"
    assert bench.captured() == VIEWS
    assert state.deviation_count == 0
    assert [(d.device, d.report["identity"]["serial"]) for d in bench.payloads(DeviceOpened)] == [
        ("camera", "C-1"),
        ("robot", "A-1"),
    ]
    photographs = [row for row in bench.store.artefacts(bench.run_id) if row.ref.kind == "image"]
    assert [row.viewpoint for row in photographs] == VIEWS
    assert len({row.ref.sha256 for row in photographs}) == len(VIEWS)
    capture = bench.payloads(ViewpointCaptured)[0]
    assert capture.environment == {"light_lux": 812.0, "temperature_c": 21.5}
    assert capture.camera["counter"] == 1
    assert capture.pose_samples > 5
    assert bench.state() == state
    bench.must_verify()


def test_the_protocol_and_rig_of_a_run_are_its_evidence(bench: Bench) -> None:
    protocol, root = recorded_run(bench.store, bench.run_id)
    assert protocol.step_ids == ("fixation", "capture", "spraying")
    rig = recorded_rig(bench.store, root)
    rig.path.write_text("name: another\ndevices: {}\n")
    with pytest.raises(ConfigurationError, match="changed since the run began"):
        recorded_rig(bench.store, root)


def test_a_completed_run_is_not_touched_again(bench: Bench) -> None:
    bench.run()
    before = bench.store.events(bench.run_id)
    assert bench.run().status == "completed"
    assert bench.store.events(bench.run_id) == before


def test_the_end_of_a_run_that_could_not_be_signed_is_signed_when_it_is_resumed(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk was full at that moment, or the process was killed, and there may be nothing left to compute."""
    sign = timestamping.checkpoint

    def full(store: Store, run_id: str) -> Checkpoint:
        if bench.state().terminal:
            raise StoreError("no space left")
        return sign(store, run_id)

    with monkeypatch.context() as patch:
        patch.setattr(timestamping, "checkpoint", full)
        assert bench.run().status == "completed"
    assert verify(bench.data).unsigned_events[bench.run_id] > 0
    assert bench.run().status == "completed"
    assert verify(bench.data).unsigned_events[bench.run_id] == 0


def test_one_run_has_one_runner(bench: Bench) -> None:
    with bench.store.lease(bench.run_id, "another runner", 30), pytest.raises(LeaseHeldError):
        bench.run()
    assert not bench.payloads(SessionStarted)


# --- pause, abort, redo, skip --------------------------------------------------------------------------------


def test_pause_in_mid_motion_stops_the_arm_and_resume_goes_on_with_the_next_viewpoint(bench: Bench) -> None:
    seen: list[tuple[bool, int]] = []

    def pause(move: int) -> None:
        if move == 3:
            bench.rig.arm.dawdle()
            bench.act("pause")

    def paused(what: str) -> None:
        if what == "paused":
            seen.append((bench.rig.arm.is_moving(), bench.rig.arm.moves))
            if len(seen) == 5:
                bench.act("resume")

    bench.rig.arm.on_move, bench.operator.on_show = pause, paused
    assert bench.run().status == "completed"
    assert bench.rig.arm.stopped_short == 1
    assert seen == [(False, 3)] * 5
    assert bench.captured() == VIEWS


def test_abort_in_mid_motion_stops_the_arm_and_ends_the_run(bench: Bench) -> None:
    def abort(move: int) -> None:
        if move == 2:
            bench.rig.arm.dawdle()
            bench.act("abort", reason="someone stepped in")

    bench.rig.arm.on_move = abort
    state = bench.run()
    assert (state.status, state.stop_reason) == ("aborted", "someone stepped in")
    assert bench.rig.arm.stopped_short == 1
    assert not bench.rig.arm.is_moving()
    assert bench.captured() == VIEWS[:1]
    bench.must_verify()


def test_redo_of_a_viewpoint_while_the_arm_moves_takes_it_again_and_keeps_both(bench: Bench) -> None:
    bench.rig.arm.on_move = lambda move: (
        bench.act("redo", step="capture", viewpoint="v001", reason="fly on the lens") if move == 3 else None
    )
    state = bench.run()
    assert state.status == "completed"
    assert sorted(bench.captured()) == ["v001", *VIEWS]
    assert [(s.viewpoint, s.reason) for s in state.superseded] == [("v001", "fly on the lens")]
    assert set(state.steps["capture"].captured) == set(VIEWS)
    assert state.steps["capture"].measures["viewpoints_captured"] == 4


def test_redo_of_a_step_while_the_arm_moves_stops_it_and_begins_again(bench: Bench) -> None:
    def redo(move: int) -> None:
        if move == 3:
            bench.rig.arm.dawdle()
            bench.act("redo", step="capture", reason="the lamp moved")

    bench.rig.arm.on_move = redo
    state = bench.run()
    assert state.status == "completed"
    assert bench.rig.arm.stopped_short == 1
    assert bench.captured() == [*VIEWS[:2], *VIEWS]
    assert {c.attempt for c in bench.payloads(ViewpointCaptured)[2:]} == {2}
    assert [(s.step, sorted(s.captured)) for s in state.superseded] == [("capture", VIEWS[:2])]


def test_an_image_is_recorded_once_the_arm_is_on_its_way_to_the_next(bench: Bench) -> None:
    recorded: list[int] = []
    bench.rig.arm.on_move = lambda _move: recorded.append(len(bench.captured()))
    assert bench.run().status == "completed"
    assert recorded == [0, 0, 1, 2]
    assert bench.captured() == VIEWS


def test_an_image_that_has_arrived_is_recorded_though_the_next_motion_is_refused(bench: Bench) -> None:
    def stop(move: int) -> None:
        if move == 3:
            bench.rig.arm.safety = SafetyState.PROTECTIVE_STOP

    bench.rig.arm.on_move = stop
    bench.script("capture", "recovery", say("abort", reason="enough"))
    assert bench.run().status == "aborted"
    assert bench.captured() == VIEWS[:2]
    bench.must_verify()


def test_skip_needs_the_protocols_leave_and_a_reason(bench: Bench) -> None:
    bench.script("fixation", "confirm", say("skip"), say("skip", reason="fixed yesterday"))
    bench.script("capture", "confirm", say("skip", reason="no time"))
    state = bench.run()
    assert state.status == "completed"
    assert state.steps["fixation"].skipped
    assert [(d.kind, d.step) for d in state.deviations if d.kind != "automatic"] == [
        ("refused", "fixation"),
        ("skip", "fixation"),
        ("refused", "capture"),
    ]
    refused = bench.payloads(ActionRefused)
    assert "needs a reason" in refused[0].why
    assert "does not allow" in refused[1].why
    assert bench.captured() == VIEWS


def test_a_confirmation_without_all_ticks_is_refused_and_recorded(bench: Bench) -> None:
    bench.script("fixation", "confirm", say("confirm", checklist=("wires hold",)))
    assert bench.run().status == "completed"
    (refused,) = bench.payloads(ActionRefused)
    assert "board lies" in refused.why
    assert any("board lies" in line for line in bench.operator.told)


def test_an_irreversible_step_waits_for_its_captures_and_a_signature(begin: Callable[[str], Bench]) -> None:
    bench = begin(PROTOCOL.replace("recovery: {retries: 2", "skippable: true\n    recovery: {retries: 2"))
    bench.script("capture", "confirm", say("skip", reason="no time"))
    bench.script(
        "spraying",
        "recovery",
        say("confirm"),
        say("sign", meaning="go"),
        say("redo", step="capture", reason="it is needed after all"),
    )
    # After the captures: a confirmation without signature, a signature of the wrong thing, then the right one.
    bench.script("spraying", "sign", say("confirm"), say("sign", signed_sha256="0" * 64))
    state = bench.run()
    assert state.status == "completed"
    whys = [refused.why for refused in bench.payloads(ActionRefused)]
    assert len(whys) == 4
    assert "not passed: capture" in whys[0]
    assert "signature first" in whys[2]
    assert "a record other than" in whys[3]
    (note,) = bench.payloads(StepNote)
    assert note.note.startswith("Blue applied")
    assert state.steps["spraying"].signed_by == "Ada"


# --- the pedal ------------------------------------------------------------------------------------------------


def test_the_pedal_confirms_what_is_asked_now_and_nothing_that_is_asked_later(bench: Bench) -> None:
    box = bench.rig.box
    assert box is not None

    def press(_question: AskOperator, _state: RunState) -> None:
        box.presses += 1

    silent = 0

    def nothing(_question: AskOperator, _state: RunState) -> OperatorAction | None:
        nonlocal silent
        silent += 1
        return None

    bench.script("fixation", "confirm", nothing, press)
    # Presses of the pedal while the robot works do not answer the next question.
    bench.rig.arm.on_move = lambda _move: press(bench.operator.asked[-1], bench.state())
    bench.script("spraying", "confirm", nothing, nothing)
    assert bench.run().status == "completed"
    confirmed = [a for a in bench.payloads(OperatorAction) if a.action == "confirm"]
    assert [(a.step, a.via) for a in confirmed] == [("fixation", "pedal"), ("capture", "cli"), ("spraying", "cli")]
    assert confirmed[0].checklist == ("wires hold", "board lies")
    assert silent == 3


def test_where_the_robot_will_move_the_pedal_is_pressed_twice_within_seconds(bench: Bench) -> None:
    box = bench.rig.box
    assert box is not None

    def press(after_s: float) -> Answer:
        def act(_question: AskOperator, _state: RunState) -> None:
            bench.ahead_s += after_s
            box.presses += 1

        return act

    def look(_question: AskOperator, _state: RunState) -> None:
        assert not bench.rig.arm.moves

    # The second press comes too late and arms again, the third bounces, the fourth counts.
    bench.script("capture", "confirm", look, press(0), press(10), press(0.1), look, press(2))
    assert bench.run().status == "completed"
    confirmed = [a for a in bench.payloads(OperatorAction) if a.step == "capture"]
    assert [(a.action, a.via) for a in confirmed] == [("confirm", "pedal")]
    assert ("asking", True) in bench.operator.attended
    assert sum("press again" in line for line in bench.operator.told) == 3


def test_a_run_without_a_light_box_works(bench: Bench) -> None:
    bench.rig.box = None
    assert bench.run().status == "completed"
    assert bench.payloads(ViewpointCaptured)[0].environment == {}


# --- bad days --------------------------------------------------------------------------------------------------


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
    assert "settings_departures" in question.text
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


def test_a_failed_job_shows_the_workers_reason_and_a_repeated_step_enqueues_it_anew(
    begin: Callable[[str], Bench],
) -> None:
    bench = begin(PROTOCOL + CALIBRATION)

    def work(_what: str) -> None:
        job = bench.store.claim_job("worker 1", 30)
        if job is None:
            return
        if job.kind == "board_view":
            bench.store.finish_job(job, measures={}, duration_s=0.1, result={"seen": False, "reason": "no board"})
        elif not bench.payloads(StepNote)[1:]:
            bench.store.fail_job(job, OSError("no memory"), retry=True)  # the store records it and retries
        elif not bench.payloads(JobFailed):
            bench.store.fail_job(job, ComputeError("the board is seen in no image"), retry=False)
        else:
            result = {"camera": {"fx": 1.0}, "details": {}}
            bench.store.finish_job(job, measures={"rms_px": 0.2}, duration_s=1.0, result=result)

    def again(question: AskOperator, _state: RunState) -> OperatorAction:
        assert "the board is seen in no image" in question.text
        return answer(question, "confirm")

    bench.operator.on_show = work
    bench.script("intrinsics", "recovery", again)
    state = bench.run()
    assert state.status == "completed"
    look, first, second = bench.payloads(JobEnqueued)
    assert look.job_kind == "board_view"
    assert first.arguments == second.arguments
    assert first.idempotency_key != second.idempotency_key
    assert state.steps["intrinsics"].result["camera"] == {"fx": 1.0}
    assert bench.captured() == [*VIEWS, "b001"]
    bench.must_verify()


def test_what_a_worker_has_computed_is_not_computed_again_after_a_crash(begin: Callable[[str], Bench]) -> None:
    bench = begin(PROTOCOL + CALIBRATION)

    def work_and_die(_what: str) -> None:
        job = bench.store.claim_job("worker 1", 30)
        if job is not None and job.kind == "board_view":
            bench.store.finish_job(job, measures={}, duration_s=0.1, result={"seen": False, "reason": "no board"})
        elif job is not None:
            result = {"camera": {"fx": 1.0}, "details": {}}
            bench.store.finish_job(job, measures={"rms_px": 0.2}, duration_s=1.0, result=result)
            raise KilledError

    bench.operator.on_show = work_and_die
    with pytest.raises(KilledError):
        bench.run()
    bench.operator.on_show = lambda _what: None
    assert bench.run().status == "completed"
    assert [job.job_kind for job in bench.payloads(JobEnqueued)] == ["board_view", "calibrate"]


# --- crashes ----------------------------------------------------------------------------------------------------


class KilledError(BaseException):
    """The process was killed."""


def _die_before_recording(bench: Bench, monkeypatch: pytest.MonkeyPatch, nth: int) -> None:
    record = bench.store.record
    seen = 0

    def dying(run_id: str, payloads: list[object], **fields: object) -> object:
        nonlocal seen
        seen += isinstance(payloads[0], ViewpointCaptured) if payloads else 0
        if payloads and isinstance(payloads[0], ViewpointCaptured) and seen == nth:
            raise KilledError
        return record(run_id, payloads, **fields)  # pyright: ignore[reportArgumentType] - passed through as it came

    monkeypatch.setattr(bench.store, "record", dying)


@pytest.mark.parametrize("nth", [1, 3, 4])
def test_killed_between_exposure_and_record_leaves_an_orphan_and_no_viewpoint_is_lost_or_doubled(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, nth: int
) -> None:
    with monkeypatch.context() as patch:
        _die_before_recording(bench, patch, nth)
        with pytest.raises(KilledError):
            bench.run()
    assert bench.captured() == VIEWS[: nth - 1]
    bench.must_verify()  # orphans are not a fault of the evidence
    files = [path for path in (bench.data / "artefacts").rglob("*") if path.is_file()]
    rows = {row.ref.sha256 for row in bench.store.artefacts(bench.run_id)}
    assert len(files) - len(rows) == 2  # photograph and pose log

    assert bench.run().status == "completed"
    assert bench.captured() == VIEWS
    assert [session.resumed for session in bench.payloads(SessionStarted)] == [False, True]
    counters = [capture.camera["counter"] for capture in bench.payloads(ViewpointCaptured)]
    assert all(earlier < later for earlier, later in pairwise(counters))
    bench.must_verify()


def test_a_defect_while_the_arm_moves_stops_it(bench: Bench) -> None:
    def die(move: int) -> None:
        if move == 2:
            bench.rig.arm.dawdle()
            raise KilledError

    bench.rig.arm.on_move = die
    with pytest.raises(KilledError):
        bench.run()
    assert bench.rig.arm.stopped_short == 1
    assert not bench.rig.arm.is_moving()


def test_a_restart_does_not_restart_the_coats_timer(begin: Callable[[str], Bench]) -> None:
    bench = begin(PROTOCOL.replace("scan_within_s: 30}", "scan_within_s: 30, settle_s: 0.5}"))

    def die(what: str) -> None:
        if what.startswith("letting the coat"):
            raise KilledError

    bench.operator.on_show = die
    with pytest.raises(KilledError):
        bench.run()
    bench.operator.on_show = lambda _what: None
    state = bench.run()
    (note,) = bench.payloads(StepNote)
    assert state.steps["spraying"].result["applied_monotonic_s"] == note.data["applied_monotonic_s"]


def test_a_run_that_was_aborted_stays_so(bench: Bench) -> None:
    bench.act("abort", reason="wrong specimen")
    assert bench.run().status == "aborted"
    assert not bench.payloads(SessionStarted)
