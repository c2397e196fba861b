"""Whatever fails in a run, it waits for a person: the arm stands, and what was captured is kept."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from drivers.errors import (
    DeviceTimeoutError,
    DeviceUnavailableError,
    DriverKilledError,
    MachineBusyError,
)
from service.core.errors import OrthocaptureError
from service.core.records.run_events import LeaveLapsed, OperatorAction, RunAborted, StepFailed, StepNote, StepStarted
from service.core.run.decide import AskOperator
from service.core.run.state import RunState
from service.store.durable_effects import DurableFiles
from service.store.store import Store
from tests.support.record.stepped_clock import SteppedClock
from tests.support.rig.bench_rig import answer
from tests.support.runs.bench_run import PROTOCOL, VIEWS, Bench, Squeezed, begin_run, say


class OddError(Exception):
    """One that nobody foresaw."""


def looks_at_a_standing_arm(bench: Bench, moves: list[int]) -> Callable[[AskOperator, RunState], OperatorAction]:
    """A person who confirms after the question was open for a while."""

    def look(question: AskOperator, _state: RunState) -> OperatorAction:
        assert not bench.rig.arm.is_moving()
        moves.append(bench.rig.arm.moves)
        return answer(question, "confirm")

    return look


@pytest.mark.parametrize("error", [OddError("odd"), MemoryError("1 TiB"), PermissionError(13, "denied", "a.jpg")])
@pytest.mark.parametrize("place", ["in motion", "at rest", "exposing"])
def test_an_error_that_nobody_foresaw_stops_the_arm_and_asks(bench: Bench, place: str, error: Exception) -> None:
    failed: list[int] = []
    asked: list[int] = []

    def fail(now: str, number: int) -> None:
        if now == place and number == 2 and not failed:
            failed.append(bench.rig.arm.moves)
            if place == "in motion":
                bench.rig.arm.dawdle()
            raise error

    def reachable(_T: object) -> bool:
        fail("at rest", bench.rig.arm.moves)
        return True

    bench.rig.arm.on_move = lambda number: fail("in motion", number)
    bench.rig.arm.reachable = reachable
    bench.rig.shutter.on_capture = lambda number: fail("exposing", number)
    bench.script("capture", "recovery", looks_at_a_standing_arm(bench, asked))
    assert bench.run().status == "completed"
    assert asked == failed, "the arm moves before a person was asked, or more than once"
    (failure,) = bench.payloads(StepFailed)
    assert (failure.error, failure.recovery) == ("UnforeseenError", "ask")
    assert type(error).__name__ in failure.message
    assert "moves for nobody until you confirm" in failure.message
    assert bench.rig.arm.stops >= 1
    assert bench.captured() == VIEWS
    bench.must_verify()


def test_after_such_an_error_the_arm_has_no_leave_until_a_person_confirms(bench: Bench) -> None:
    """It is closed, so that its driver holds no leave either."""

    def fail(number: int) -> None:
        if number == 2 and bench.rig.arm.connected and not bench.payloads(StepFailed):
            raise OddError("odd")

    def look(question: AskOperator, _state: RunState) -> OperatorAction:
        assert not bench.rig.arm.connected
        return answer(question, "confirm")

    bench.rig.shutter.on_capture = fail
    bench.script("capture", "recovery", look)
    assert bench.run().status == "completed"


def test_a_driver_that_was_killed_is_asked_about_and_not_tried_again_before(bench: Bench) -> None:
    exposures: list[int] = []

    def fail(number: int) -> None:
        exposures.append(number)
        if number == 2:
            raise DriverKilledError("driver process is not running: died of SIGKILL", where="camera")

    def look(question: AskOperator, _state: RunState) -> OperatorAction:
        assert exposures == [1, 2]
        assert "SIGKILL" in question.text
        return answer(question, "confirm")

    bench.rig.shutter.on_capture = fail
    bench.script("capture", "recovery", look)
    assert bench.run().status == "completed"
    assert [f.error for f in bench.payloads(StepFailed)] == ["DriverKilledError"]
    assert bench.captured() == VIEWS


@pytest.mark.parametrize("late", [DeviceTimeoutError, DeviceUnavailableError, MachineBusyError])
def test_what_is_late_on_a_starved_machine_is_waited_out(bench: Bench, late: type[DeviceTimeoutError]) -> None:
    failures = 12  # three tries of four attempts

    def fail(number: int) -> None:
        if 1 < number <= 1 + failures:
            raise late("solve_ik did not return within 30 s", where="camera")

    bench.rig.shutter.on_capture = fail
    bench.held_up = lambda: Squeezed(43.0, 0.86)
    assert bench.run().status == "completed"
    failed = bench.payloads(StepFailed)
    assert [f.recovery for f in failed] == ["retry"] * 4
    assert "This computer is short of processor time" in failed[-1].message
    assert "43 s, 86 % of the time" in failed[-1].message
    notes = [note.data for note in bench.payloads(StepNote) if note.note == "processor_short"]
    assert notes == [{"waited_s": 43.0, "share": 0.86}] * 4
    assert bench.captured() == VIEWS


@pytest.mark.parametrize("squeezed", [Squeezed(0.0, 0.0), Squeezed(0.5, 0.9), Squeezed(40.0, 0.1)])
def test_what_is_late_on_a_machine_with_time_to_spare_is_asked_about(bench: Bench, squeezed: Squeezed) -> None:
    def fail(number: int) -> None:
        if number > 1:
            raise DeviceTimeoutError("no answer", where="camera")

    bench.rig.shutter.on_capture = fail
    bench.held_up = lambda: squeezed
    bench.script("capture", "recovery", say("abort", reason="enough"))
    assert bench.run().status == "aborted"
    assert [f.recovery for f in bench.payloads(StepFailed)] == ["retry", "retry", "ask"]


def test_a_machine_that_stays_starved_is_asked_about(bench: Bench) -> None:
    def fail(number: int) -> None:
        if number > 1:
            raise MachineBusyError("no answer", where="camera")

    bench.rig.shutter.on_capture = fail
    bench.held_up = lambda: Squeezed(43.0, 0.86)
    bench.script("capture", "recovery", say("abort", reason="enough"))
    assert bench.run().status == "aborted"
    assert [f.recovery for f in bench.payloads(StepFailed)] == ["retry"] * 7 + ["ask"]
    assert not bench.payloads(LeaveLapsed)


def test_a_protocol_that_says_abort_asks_and_recommends_it(begin: Callable[[str], Bench]) -> None:
    bench = begin(PROTOCOL.replace("{retries: 2, wait_s: 0}", "{retries: 0, wait_s: 0, on_failure: abort}"))

    def fail(number: int) -> None:
        if number == 2:
            raise DeviceTimeoutError("no answer", where="camera")

    def recommended(question: AskOperator, _state: RunState) -> OperatorAction:
        assert question.ways[0].verb == "abort"
        assert "The protocol recommends to end the run here" in question.text
        return answer(question, "confirm")

    bench.rig.shutter.on_capture = fail
    bench.script("capture", "recovery", recommended)
    assert bench.run().status == "completed"
    assert not bench.payloads(RunAborted)


class FullFiles(DurableFiles):
    """A disk on which nothing can be committed for a time."""

    full = False

    def commit(self, commit: Callable[[], None]) -> None:
        if self.full:
            raise OSError(28, "No space left on device")
        super().commit(commit)


@pytest.mark.parametrize("place", ["in motion", "exposing"])
def test_a_record_that_cannot_be_written_is_waited_for(tmp_path: Path, place: str) -> None:
    files = FullFiles()
    with Store.open(tmp_path / "data", SteppedClock.from_now(), files=files) as store:
        bench = begin_run(store, PROTOCOL, tmp_path)
        rounds: list[int] = []
        moves: list[int] = []

        def fill(now: str, number: int) -> None:
            if now == place and number == 2 and not rounds:
                files.full = True

        def wait(seconds: float) -> None:
            if files.full and seconds == 1.0:
                assert not bench.rig.arm.is_moving()
                rounds.append(bench.rig.arm.moves)
                files.full = len(rounds) < 90

        def look(question: AskOperator, _state: RunState) -> OperatorAction:
            moves.append(bench.rig.arm.moves)
            return answer(question, "confirm")

        bench.rig.arm.on_move = lambda number: fill("in motion", number)
        bench.rig.shutter.on_capture = lambda number: fill("exposing", number)
        bench.on_wait = wait
        bench.script("capture", "recovery", look, look)
        bench.script("capture", "confirm", look, look)
        assert bench.run().status == "completed"
        assert len(rounds) == 90
        assert len(set(rounds)) == 1, "the arm moves while nothing can be recorded"
        assert moves[-1] == rounds[0], "the arm moves before a person was asked"
        told = [line for line in bench.operator.told if "the run waits" in line]
        assert len(told) == 2, "said at once, and a minute later again"
        assert "No space left on device" in told[0]
        assert any("the run goes on, after 9" in line for line in bench.operator.told)
        assert list(dict.fromkeys(bench.captured())) == VIEWS
        (lapsed,) = bench.payloads(LeaveLapsed)
        assert "No space left on device" in lapsed.why
        bench.must_verify()


def test_a_simulated_technician_who_does_not_answer_is_asked_about_and_tried_again(bench: Bench) -> None:
    calls: list[int] = []

    def prepare() -> None:
        calls.append(1)
        if len(calls) in (2, 3):  # of the capture
            raise OrthocaptureError("the simulated technician does not answer", where="127.0.0.1:9")

    bench.operator.on_prepare = prepare
    bench.script("capture", "recovery", say("confirm"), say("confirm"))
    assert bench.run().status == "completed"
    assert [f.message.startswith("the simulated technician") for f in bench.payloads(StepFailed)] == [True, True]
    assert [s.step for s in bench.payloads(StepStarted)].count("capture") == 1
    assert bench.operator.prepared[1:4] == [("capture", 1), ("capture", 2), ("capture", 3)]
