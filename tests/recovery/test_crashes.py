"""A runner that dies in the middle, and jobs that failed: the run goes on where it was."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import pytest

from service.computations.calibration import BoardViewAnswer, CalibrateAnswer, CalibrationDetails
from service.computations.records import Camera
from service.core.errors import ComputeError
from service.core.records.run_events import (
    JobEnqueued,
    JobFailed,
    OperatorAction,
    SessionStarted,
    StepNote,
    ViewpointCaptured,
)
from service.core.run.decide import AskOperator
from service.core.run.state import RunState
from service.monitor.snapshot import SignOfLife
from tests.support.rig.bench_rig import answer
from tests.support.runs.bench_run import PROTOCOL, VIEWS, Bench, KilledError

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
NO_BOARD = BoardViewAnswer(viewpoint="b1", size=(640, 426), seen=False, reason="no board").plain()
_CAMERA = Camera(width=640, height=426, fx=930.0, fy=930.0, cx=320.0, cy=213.0)
SOLVED = CalibrateAnswer(camera=_CAMERA, details=CalibrationDetails()).plain()


# --- bad days --------------------------------------------------------------------------------------------


def test_a_failed_job_shows_the_workers_reason_and_a_repeated_step_enqueues_it_anew(
    begin: Callable[[str], Bench],
) -> None:
    bench = begin(PROTOCOL + CALIBRATION)

    def work(_what: str) -> None:
        job = bench.store.claim_job("worker 1", 30)
        if job is None:
            return
        if job.kind == "board_view":
            bench.store.finish_job(job, measures={}, duration_s=0.1, result=NO_BOARD)
        elif not bench.payloads(StepNote)[1:]:
            bench.store.fail_job(job, OSError("no memory"), retry=True)  # the store records it and retries
        elif not bench.payloads(JobFailed):
            bench.store.fail_job(job, ComputeError("the board is seen in no image"), retry=False)
        else:
            bench.store.finish_job(job, measures={"rms_px": 0.2}, duration_s=1.0, result=SOLVED)

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
    assert state.steps["intrinsics"].result["camera"] == SOLVED["camera"]
    assert bench.captured() == [*VIEWS, "b001"]
    bench.must_verify()


def test_that_nobody_computes_is_told_and_again_when_the_worker_has_gone(begin: Callable[[str], Bench]) -> None:
    bench = begin(PROTOCOL + CALIBRATION)
    sign = SignOfLife(bench.data, bench.clock)
    waited: list[int] = []

    def work(what: str) -> None:
        if what != "looking for the board":
            return
        waited.append(len([told for told in bench.operator.told if "no worker is running" in told]))
        bench.clock.passed_s += 6
        match len(waited):
            case number if 20 <= number < 30:
                sign.give(0)
            case 30:
                sign.close()
            case 50:
                bench.operator.on_show = finish
            case _:
                pass

    def finish(_what: str) -> None:
        job = bench.store.claim_job("worker 1", 30)
        if job is not None:
            looked = job.kind == "board_view"
            measures = {} if looked else {"rms_px": 0.2}
            bench.store.finish_job(job, measures=measures, duration_s=0.1, result=NO_BOARD if looked else SOLVED)

    bench.operator.on_show = work
    assert bench.run().status == "completed"
    assert [waited[at] for at in (3, 10, 28, 33, 40)] == [0, 1, 1, 1, 2]
    assert (
        f"1 computation waits, and no worker is running. Start one with `orthocapture worker --data {bench.data}`"
    ) in bench.operator.told


def test_what_a_worker_has_computed_is_not_computed_again_after_a_crash(begin: Callable[[str], Bench]) -> None:
    bench = begin(PROTOCOL + CALIBRATION)

    def work_and_die(_what: str) -> None:
        job = bench.store.claim_job("worker 1", 30)
        if job is not None and job.kind == "board_view":
            bench.store.finish_job(job, measures={}, duration_s=0.1, result=NO_BOARD)
        elif job is not None:
            bench.store.finish_job(job, measures={"rms_px": 0.2}, duration_s=1.0, result=SOLVED)
            raise KilledError

    bench.operator.on_show = work_and_die
    with pytest.raises(KilledError):
        bench.run()
    bench.operator.on_show = lambda _what: None
    assert bench.run().status == "completed"
    assert [job.job_kind for job in bench.payloads(JobEnqueued)] == ["board_view", "calibrate"]


# --- crashes ---------------------------------------------------------------------------------------------


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
