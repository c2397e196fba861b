"""Between a person's confirmation and a motion lies no more than the protocol's time without visible progress."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import pytest

from drivers.errors import DeviceTimeoutError
from service.core.records.run_events import LeaveLapsed, OperatorAction, StepFailed, StepRetried
from service.core.run.decide import AskOperator
from service.core.run.expected import tries_words
from service.core.run.state import RunState
from service.monitor.snapshot import SignOfLife
from service.runner import leave
from service.runner.held_run import held_run
from service.runner.leave import LeaveWatch
from service.steps.context import StepInterruptedError
from tests.support.rig.bench_rig import answer
from tests.support.runs.bench_run import PROTOCOL, VIEWS, Bench

HOLDS_S = 60.0
RETRIES = "recovery: {retries: 2, wait_s: 0}"


@dataclass
class Attended:
    """When the person let the robot move, when something became visible of it, and when the arm set out."""

    bench: Bench
    let_s: list[float] = field(default_factory=list[float])
    gaps_s: list[float] = field(default_factory=list[float])  # before each motion, since the last sign
    questions: list[str] = field(default_factory=list[str])

    def __post_init__(self) -> None:
        self.bench.rig.arm.on_move = self._sets_out
        self.bench.operator.script = {("capture", kind): [self.let] * 30 for kind in ("confirm", "recovery")}

    def let(self, question: AskOperator, _state: RunState) -> OperatorAction:
        self.questions.append(question.text)
        self.let_s.append(self.bench.clock.monotonic_s())
        return answer(question, "confirm")

    def _sets_out(self, _number: int) -> None:
        last_s = max([*self.let_s[-1:], *self.bench.rig.shutter.arrivals_s[-1:]])
        self.gaps_s.append(self.bench.clock.monotonic_s() - last_s)


def no_file(bench: Bench, *exposures: int, after_s: float = 46.0) -> None:
    """Let these exposures bring no file within that time."""

    def fail(exposure: int) -> None:
        if exposure in exposures:
            bench.clock.sleep(after_s)
            raise DeviceTimeoutError(f"no file within {after_s:.0f} s", where="camera", remedy="Look at the camera")

    bench.rig.shutter.on_capture = fail


@pytest.mark.parametrize("wait_s", [0, 30])
def test_no_motion_comes_long_after_the_confirmation(begin: Callable[[str], Bench], wait_s: int) -> None:
    """The camera fails again and again: the arm set out three minutes after the hold, and nobody was asked."""
    bench = begin(PROTOCOL.replace(RETRIES, f"recovery: {{retries: 2, wait_s: {wait_s}}}"))
    attended = Attended(bench)
    no_file(bench, 1, 2, 3, 4, 5)
    state = bench.run()
    assert state.status == "completed"
    assert bench.captured() == VIEWS
    assert attended.gaps_s
    assert max(attended.gaps_s) <= HOLDS_S, attended.gaps_s
    lapses = bench.payloads(LeaveLapsed)
    assert lapses
    assert all(lapse.limit_s == HOLDS_S < lapse.idle_s for lapse in lapses)
    assert lapses[0].why == "v001 failed twice: no file within 46 s"
    assert f"no longer lets the robot move: for {lapses[0].idle_s:.0f} s" in attended.questions[1]
    assert "v001 failed twice: no file within 46 s" in attended.questions[1]
    assert not bench.payloads(StepFailed), "a lapse is no failure: the attempt goes on"
    bench.must_verify()


def test_a_wait_before_a_try_that_begins_by_itself_ends_in_a_question(begin: Callable[[str], Bench]) -> None:
    bench = begin(PROTOCOL.replace(RETRIES, "recovery: {retries: 1, wait_s: 50}"))
    attended = Attended(bench)
    no_file(bench, 1, 2, after_s=20.0)
    assert bench.run().status == "completed"
    assert max(attended.gaps_s) <= HOLDS_S
    assert len(bench.payloads(LeaveLapsed)) == 1
    assert [retried.why for retried in bench.payloads(StepRetried)] == ["the operator asked for it"]
    (_, question) = attended.questions
    assert question.startswith("DeviceTimeoutError: no file within 20 s")
    assert "The confirmation of Ada no longer lets the robot move" in question


def test_a_device_that_takes_long_to_connect_lets_the_confirmation_lapse(bench: Bench) -> None:
    attended = Attended(bench)
    connect, bench.rig.arm.open = bench.rig.arm.open, lambda: (bench.clock.sleep(80.0), connect())[1]  # type: ignore[method-assign]
    assert bench.run().status == "completed"
    assert max(attended.gaps_s) <= HOLDS_S
    assert len(bench.payloads(LeaveLapsed)) == 1


def test_a_capture_with_progress_is_not_asked_about(bench: Bench) -> None:
    """Each image takes 50 s and is seen to arrive: nobody is asked again, however long it takes in all."""
    attended = Attended(bench)
    bench.rig.shutter.on_capture = lambda _exposure: bench.clock.sleep(50.0)
    assert bench.run().status == "completed"
    assert len(attended.questions) == 1
    assert not bench.payloads(LeaveLapsed)


def test_a_slow_motion_is_no_wait(bench: Bench) -> None:
    attended = Attended(bench)
    sets_out = bench.rig.arm.on_move

    def slow(number: int) -> None:
        sets_out(number)
        bench.clock.sleep(90.0)

    bench.rig.arm.on_move = slow
    no_file(bench, 1, after_s=1.0)
    assert bench.run().status == "completed"
    assert len(attended.questions) == 1


@pytest.mark.parametrize("by_s", [-3600.0, 3600.0])
def test_a_clock_that_is_stepped_asks_once_more_and_never_hides_a_wait(bench: Bench, by_s: float) -> None:
    """Set forward, or back: how old the confirmation is cannot be told, and it is asked for again."""
    attended = Attended(bench)

    def step(exposure: int) -> None:
        if exposure == 1:
            bench.clock.set_utc(by_s)
            raise DeviceTimeoutError("no file within 1 s", where="camera")

    bench.rig.shutter.on_capture = step
    assert bench.run().status == "completed"
    assert len(attended.questions) == 2
    assert len(bench.payloads(LeaveLapsed)) == 1


def test_a_resumption_is_a_new_confirmation(begin: Callable[[str], Bench]) -> None:
    bench = begin(PROTOCOL)
    attended, paused = Attended(bench), list[str]()

    def pause(exposure: int) -> None:
        if exposure == 1:
            bench.act("pause")
            raise DeviceTimeoutError("no file within 1 s", where="camera")

    def resume(what: str) -> None:
        if what == "paused":
            paused.append(what)
            bench.clock.sleep(1.0)
        if len(paused) == 500 and bench.state().paused:
            bench.act("resume")
            attended.let_s.append(bench.clock.monotonic_s())

    bench.rig.shutter.on_capture, bench.operator.on_show = pause, resume
    assert bench.run().status == "completed"
    assert max(attended.gaps_s) <= HOLDS_S
    assert len(attended.questions) == 1


def test_the_time_is_the_protocols(begin: Callable[[str], Bench]) -> None:
    bench = begin(PROTOCOL.replace("motion: {dwell_s: 0.0}", "motion: {dwell_s: 0.0, confirmed_for_s: 200}"))
    attended = Attended(bench)
    no_file(bench, 1, 2)
    assert bench.run().status == "completed"
    assert len(attended.questions) == 1
    assert 92.0 <= max(attended.gaps_s) <= 200.0


# --- processor time, and results that workers compute ------------------------------------------------------------


@pytest.fixture
def told() -> list[str]:
    return []


def confirmed(bench: Bench, told: list[str], check: Callable[[LeaveWatch, list[float]], None]) -> None:
    """Have the capture confirmed, and check what becomes of that leave."""
    busy_s = [0.0]
    with held_run(bench.store, bench.run_id, bench.protocol) as run:
        watch = LeaveWatch(run, bench.protocol, bench.data, bench.clock, told.append, busy_s=lambda: busy_s[0])
        bench.act("skip", step="fixation", reason="no need")
        watch.look(run.refresh())
        bench.act("confirm", step="capture")
        watch.look(run.refresh())
        check(watch, busy_s)


def sets_out(watch: LeaveWatch) -> bool:
    try:
        with watch.motion():
            return True
    except StepInterruptedError:
        return False


def test_computing_and_waiting_for_a_processor_is_progress_and_is_said(bench: Bench, told: list[str]) -> None:
    def check(watch: LeaveWatch, busy_s: list[float]) -> None:
        bench.clock.sleep(150.0)
        busy_s[0] = 120.0
        assert sets_out(watch)
        bench.clock.sleep(40.0)
        assert not sets_out(watch)

    confirmed(bench, told, check)
    assert told == [
        "the robot sets out 150 s after the last progress: for 120 s of that the computer computed, or waited for a "
        "processor"
    ]


@pytest.mark.parametrize("lives", [True, False])
def test_waiting_for_results_is_progress_while_a_worker_lives(bench: Bench, told: list[str], lives: bool) -> None:
    def check(watch: LeaveWatch, _busy_s: list[float]) -> None:
        sign = SignOfLife(bench.data, bench.clock)
        for _ in range(200):
            if lives:
                sign.give(0)
            watch.wait_for_results(0.5)
        assert sets_out(watch) == lives
        sign.close()

    confirmed(bench, told, check)


def test_a_count_counts_once(bench: Bench, told: list[str]) -> None:
    """An attempt that shows again what the last one had done is no progress."""

    def check(watch: LeaveWatch, _busy_s: list[float]) -> None:
        for done in (0, 1, 1, 1):
            bench.clock.sleep(25.0)
            watch.progress("viewpoints", done)
        assert sets_out(watch)
        bench.clock.sleep(25.0)
        watch.progress("viewpoints", 1)
        assert not sets_out(watch)

    confirmed(bench, told, check)


def test_a_newer_confirmation_is_not_taken_away(bench: Bench) -> None:
    attended = Attended(bench)
    no_file(bench, 1, 2)
    bench.run()
    first = bench.state().steps["capture"]
    assert first.phase == "passed"
    before = bench.state()
    assert before.leave is not None
    bench.store.record(bench.run_id, [LeaveLapsed(leave_seq=1, idle_s=99.0, limit_s=60.0)], actor="runner")
    assert bench.state().leave == before.leave
    assert attended.questions


def test_this_threads_processor_time_goes_on() -> None:
    before_s = leave.processor_s()
    total = sum(number * number for number in range(2_000_000))
    assert total
    assert leave.processor_s() > before_s


# --- what is said of tries that begin by themselves ----------------------------------------------------------


def test_each_try_that_begins_by_itself_says_why_and_when(begin: Callable[[str], Bench]) -> None:
    bench = begin(PROTOCOL.replace(RETRIES, "recovery: {retries: 1, wait_s: 10}"))
    no_file(bench, 1, 2, after_s=4.0)
    said: list[str] = []

    def attend(_doing: str) -> None:
        words = tries_words(bench.protocol, bench.state(), lambda at_utc: at_utc[11:16])
        if words and (not said or said[-1] != words):
            said.append(words)

    bench.operator.on_attend = attend
    assert bench.run().status == "completed"
    at = [event.at_utc for event in bench.store.events(bench.run_id) if event.payload.kind == "viewpoint_failed"]
    assert said[0] == f"v001 failed once: no file within 4 s; try 2 since {at[0][11:16]}, by itself"
    assert said[1].startswith("v001 failed twice: no file within 4 s; try 3 at ")
    assert said[2].startswith("v001 failed twice: no file within 4 s; try 3 since ")
    assert any(line.startswith("v001 failed twice") for line in bench.operator.told)
    assert bench.state().steps["capture"].tries is None
