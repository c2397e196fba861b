"""The motion latch, and which samples of an arm's stream count, on a clock that only the test moves."""

from __future__ import annotations

import contextlib
import dataclasses
from collections import deque
from collections.abc import Callable, Generator
from multiprocessing import Pipe

import numpy as np
import pytest

from drivers.arm import latch as latch_module
from drivers.arm import stream as stream_module
from drivers.arm.latch import Latch
from drivers.arm.stream import BUFFER_S, PoseStream, driven, judge, ringing_s, within
from drivers.errors import DeviceUnavailableError, LeaveNeededError, SafetyStopError
from drivers.host.heartbeat import BEAT, BEAT_S, Line
from drivers.interfaces import RobotSample, SafetyState, SettleCriteria
from service.core.geometry import transform
from tests.support.processes.waiting import until


class Clock:
    """Stands for the module `time` of a driver; a sleep takes the time with it."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.meanwhile: Callable[[], object] = int

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds
        self.meanwhile()


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    for module in (latch_module, stream_module):
        monkeypatch.setattr(module, "time", made)
    return made


# --- the latch -------------------------------------------------------------------------------------------


def test_an_arm_is_held_until_a_named_person_lets_it_move(clock: Clock) -> None:
    latch = Latch("arm 1")
    assert isinstance(latch.hold, LeaveNeededError)
    assert latch.stop is None, "nothing has happened yet that a person would have to look into"
    latch.let_move("", clock.now_s)
    assert latch.hold is not None, "nobody is no person"
    latch.let_move("Ada", clock.now_s)
    assert latch.hold is None
    latch.close()
    assert "nobody has let the arm move since it was connected" in str(latch.hold)


@pytest.mark.parametrize("state", [state for state in SafetyState if not state.may_move])
def test_a_stop_that_came_and_went_holds_the_arm(clock: Clock, state: SafetyState) -> None:
    latch = Latch("arm 1")
    latch.let_move("Ada", clock.now_s)
    latch.see(SafetyState.NORMAL, clock.now_s)
    latch.see(SafetyState.REDUCED, clock.now_s)
    assert latch.hold is None
    latch.see(state, clock.now_s)
    latch.see(SafetyState.NORMAL, clock.now_s + 1)
    clock.now_s += 3.0
    for held in (latch.stop, latch.hold):
        assert isinstance(held, SafetyStopError)
        assert f"the arm was in {state.value.replace('_', ' ')} 3 s ago, and nobody has confirmed since" in str(held)
        assert "arm 1" in str(held)


def test_who_confirmed_before_the_stop_was_over_has_not_confirmed_it(clock: Clock) -> None:
    latch = Latch("arm 1")
    latch.let_move("Ada", clock.now_s)
    latch.see(SafetyState.PROTECTIVE_STOP, 101.0, "a collision")
    latch.see(SafetyState.PROTECTIVE_STOP, 102.0, "a collision")
    with pytest.raises(SafetyStopError, match="a collision"):
        latch.let_move("Ada", 101.5)
    assert latch.hold is not None
    latch.let_move("Grace", 102.0)
    assert latch.hold is None
    assert latch.stop is None


def test_the_unexpected_end_of_a_program_holds_the_arm_as_a_stop_does(clock: Clock) -> None:
    latch = Latch("arm 1")
    latch.let_move("Ada", clock.now_s)
    latch.end("the script was ended at the pendant")
    assert isinstance(latch.stop, LeaveNeededError)
    assert isinstance(latch.hold, LeaveNeededError)
    assert "the script was ended at the pendant, and nobody has confirmed since" in str(latch.hold)
    with pytest.raises(LeaveNeededError, match="at the pendant"):
        latch.let_move("Ada", clock.now_s - 0.1)
    latch.see(SafetyState.FAULT, clock.now_s)
    assert isinstance(latch.hold, SafetyStopError), "the stop is told first"
    latch.let_move("Ada", clock.now_s)
    assert latch.hold is None


# --- the stream ------------------------------------------------------------------------------------------


def sample(at_s: float, *, target: float = 0.0, controller_s: float | None = None, **speeds: float) -> RobotSample:
    joints = np.zeros(6)
    joints[2] = speeds.get("joint", 0.0)
    driving = np.zeros(6)
    driving[4] = target
    place = transform(np.eye(3), np.array([0.4, at_s - 100.0 if speeds.get("creeps") else 0.0, 0.2]))
    return RobotSample(
        at_s if controller_s is None else controller_s, at_s, joints, joints, driving, place, speeds.get("tcp", 0.0),
        SafetyState.NORMAL,
    )  # fmt: skip


class Source:
    """Samples that the stream is to read."""

    def __init__(self) -> None:
        self.waiting: deque[RobotSample] = deque()
        self.stream = PoseStream(self._read, stale_after_s=0.5, where="arm 1", vendor_errors=(ConnectionError,))

    def _read(self) -> RobotSample | None:
        return self.waiting.popleft() if self.waiting else None

    def bring(self, *samples: RobotSample) -> None:
        self.waiting.extend(samples)
        self.stream.catch_up()
        until(lambda: not self.waiting, "taken", every_s=0.001)
        self.stream.catch_up()  # waits for the other thread's last one


@pytest.fixture
def source(clock: Clock) -> Generator[Source]:
    made = Source()
    yield made
    made.stream.close()


def test_a_sample_is_stale_after_its_time(source: Source, clock: Clock) -> None:
    assert source.stream.newest() is None
    assert not source.stream.alive
    source.bring(sample(99.8), sample(100.0))
    clock.now_s = 100.49
    assert source.stream.newest() is not None
    assert source.stream.latest().monotonic_s == 100.0
    clock.now_s = 100.51
    assert source.stream.newest() is None
    assert not source.stream.alive


def test_a_stream_without_samples_is_told_after_a_wait(source: Source, clock: Clock) -> None:
    with pytest.raises(DeviceUnavailableError, match="no new sample yet"):
        source.stream.latest()
    assert clock.now_s > 100.5, "it may only be late"
    source.stream.await_first(2.0)
    assert clock.now_s > 102.5
    began_s = clock.now_s
    source.bring(sample(began_s))
    source.stream.await_first(2.0)
    assert clock.now_s == began_s


def test_what_came_before_the_question_does_not_answer_it(source: Source, clock: Clock) -> None:
    source.bring(sample(99.9), sample(100.0))
    clock.meanwhile = lambda: source.bring(sample(clock.now_s))
    assert source.stream.next().monotonic_s == pytest.approx(100.004)


def test_samples_are_found_by_their_time_and_go_when_they_are_old(source: Source) -> None:
    source.bring(*(sample(100.0 + k) for k in range(5)))
    assert [s.monotonic_s for s in source.stream.between(101.0, 103.0)] == [101.0, 102.0, 103.0]
    assert source.stream.between(105.0, 106.0) == ()
    source.bring(sample(101.5 + BUFFER_S))
    assert [s.monotonic_s for s in source.stream.between(0.0, 104.0)] == [102.0, 103.0, 104.0]
    source.stream.clear()
    assert source.stream.between(0.0, 1e9) == ()


def test_the_clock_is_that_of_the_least_delayed_sample_of_five_seconds(source: Source, clock: Clock) -> None:
    early = sample(80.0, controller_s=85.0)  # of long ago, when the controller's clock was set otherwise
    source.bring(early, *(sample(90.0 + 0.008 * k, controller_s=92.0 + 0.008 * k) for k in range(625)))
    clock.now_s = 95.0
    source.bring(sample(95.0, controller_s=96.9), sample(95.1, controller_s=97.103))
    clock.now_s = 95.2
    assert source.stream.clock_offset_s() == pytest.approx(2.003)


def test_a_window_ends_where_it_should() -> None:
    samples = deque(sample(float(k)) for k in range(4))
    assert [s.monotonic_s for s in within(samples, 1.0, 2.0)] == [1.0, 2.0]
    assert within(samples, 2.5, 2.9) == ()


# --- standing still --------------------------------------------------------------------------------------

CRITERIA = SettleCriteria(window_s=0.5, joint_speed_rad_s=0.001, tcp_speed_m_s=0.0002)


def window(length_s: float = 0.5, **of: float) -> list[RobotSample]:
    return [sample(100.0 + t, **of) for t in np.linspace(0.0, length_s, 26)]


def test_an_arm_that_stands_for_most_of_the_window_has_settled() -> None:
    found = judge(window(0.41), CRITERIA)
    assert (found.settled, found.samples, found.joint_speed_rad_s, found.tcp_speed_m_s) == (True, 26, 0.0, 0.0)
    assert np.allclose(found.T_base_flange[:3, 3], [0.4, 0.0, 0.2])
    assert np.allclose(found.joints_rad, 0.0)
    assert not judge(window(0.39), CRITERIA).settled, "less than 0.8 of the window"


def test_what_is_stated_of_the_joints_is_the_mean_of_each() -> None:
    samples = [dataclasses.replace(one, joints_rad=0.1 * np.arange(6) + 0.001 * k) for k, one in enumerate(window())]
    assert np.allclose(judge(samples, CRITERIA).joints_rad, 0.1 * np.arange(6) + 0.0125)


@pytest.mark.parametrize(
    ("of", "settles"),
    [
        ({"joint": 0.0009}, True), ({"joint": 0.0011}, False), ({"joint": -0.0011}, False),
        ({"tcp": 0.00019}, True), ({"tcp": 0.00021}, False), ({"target": 1e-8}, False), ({"target": -1e-8}, False),
        ({"creeps": 1.0}, False),
    ],
)  # fmt: skip
def test_what_keeps_an_arm_from_having_settled(of: dict[str, float], settles: bool) -> None:
    assert judge(window(**of), CRITERIA).settled is settles
    disturbed = [*window()[:10], sample(100.2, **of), *window()[11:]]
    assert judge(disturbed, CRITERIA).settled is settles


def test_an_arm_that_is_driven_in_any_axis_is_driven() -> None:
    assert driven(sample(0.0, target=2e-9))
    assert driven(sample(0.0, target=-2e-9))
    assert not driven(sample(0.0, target=1e-10))


@pytest.mark.parametrize("loud", [{"joint": 0.002}, {"joint": -0.002}, {"tcp": 0.001}])
def test_it_rings_until_the_last_loud_sample(loud: dict[str, float]) -> None:
    motion = [sample(100.0, target=0.1), sample(100.1, target=0.1)]
    after = [sample(100.2, **loud), sample(100.3), sample(100.4, **loud), sample(100.5), sample(100.6)]
    assert ringing_s([*motion, *after], CRITERIA) == pytest.approx(0.3)
    assert ringing_s([*motion, *after[3:]], CRITERIA) == 0.0
    assert ringing_s(after, CRITERIA) == 0.0, "not back to the motion"


@pytest.mark.parametrize("loud", [{"joint": 0.001}, {"joint": -0.001}, {"tcp": 0.0002}])
def test_an_arm_at_a_limit_of_the_speeds_still_rings_and_has_not_settled(loud: dict[str, float]) -> None:
    assert not judge([*window(), sample(100.5, **loud)], CRITERIA).settled
    assert ringing_s([sample(100.0, target=0.1), sample(100.2, **loud), sample(100.3)], CRITERIA) > 0.1


# --- the heartbeat between two programs ------------------------------------------------------------------


def test_requests_and_beats_travel_and_the_beats_end_with_the_line() -> None:
    """The watchdog's limit is 0.2 s, so that several beats must fit into it."""
    assert BEAT_S <= 0.2 / 4
    here, there = Pipe()
    line = Line(here)
    line.send((1, "pose", (), {}))
    assert there.recv() == (1, "pose", (), {})
    assert not there.poll(0.0), "no beat before it begins"
    line.begin()
    assert there.poll(10.0)
    number, word, (sent_s,), named = there.recv()
    assert (number, word, named) == (0, BEAT, {})
    assert isinstance(sent_s, float)
    there.send("answer")
    assert line.poll(10.0)
    assert line.receive() == "answer"
    line.close()
    with contextlib.suppress(EOFError):
        while True:
            assert there.recv()[1] == BEAT
    assert here.closed
