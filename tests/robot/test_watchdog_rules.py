"""When the Universal Robots driver kicks the controller's watchdog, and what it makes of a script that has ended."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field

import numpy as np
import pytest

from drivers.arm.latch import Latch
from drivers.errors import LeaveNeededError
from drivers.interfaces import RobotSample, SafetyState
from drivers.ur import safety, watchdog
from drivers.ur.watchdog import LAPSE_S, LATE, Watchdog

WATCHDOG_S, UNATTENDED_S = 0.2, 2.0


class Clock:
    """Stands for the module `time` of the driver."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s


@dataclass
class Control:
    """The vendor's control interface, of a controller whose script runs until it is ended."""

    runs: bool = True
    connected: bool = True
    accepts: bool = True
    kicks: int = 0
    frequencies_hz: list[float] = field(default_factory=list[float])

    def isProgramRunning(self) -> bool:
        return self.runs

    def isConnected(self) -> bool:
        return self.connected

    def setWatchdog(self, min_frequency_hz: float) -> bool:
        self.frequencies_hz.append(min_frequency_hz)
        return self.accepts

    def kickWatchdog(self) -> bool:
        self.kicks += 1
        return True


def sample(*, driven: bool) -> RobotSample:
    zeros = np.zeros(6)
    target = np.array([0.0, 0.0, 0.0, 0.0, 0.0, -0.3 if driven else 0.0])
    return RobotSample(0.0, 0.0, zeros, zeros, target, np.eye(4), 0.0, SafetyState.NORMAL)


class Guarded:
    """A watchdog on a clock that only the test moves, guarding a script for an arm that a person has let move."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.clock, self.control, self.latch = Clock(), Control(), Latch("arm")
        monkeypatch.setattr(watchdog, "time", self.clock)
        self.sample: RobotSample | None = sample(driven=False)
        self._looked = threading.Event()
        self.watchdog = Watchdog(self.latch, watchdog_s=WATCHDOG_S, unattended_s=UNATTENDED_S, newest=self._newest)
        self.latch.let_move("Ada", 0.0)
        self.watchdog.guard(self.control)  # pyright: ignore[reportArgumentType]  # the calls that are used here

    def _newest(self) -> RobotSample | None:
        self._looked.set()
        return self.sample

    def beat(self, *, late_s: float = 0.0) -> int:
        """Send a heartbeat, wait until it was dealt with, and return how many kicks there were so far."""
        self._looked.clear()
        self.watchdog.beat(self.clock.now_s - late_s)
        assert self._looked.wait(10.0)
        self.watchdog.look()  # waits for the kick that is under way
        return self.control.kicks

    def after(self, seconds: float) -> None:
        self.clock.now_s += seconds

    @property
    def held(self) -> str:
        """Why the arm is held; nothing if it may move."""
        found = self.latch.hold
        assert found is None or isinstance(found, LeaveNeededError)
        return "" if found is None else str(found)


@pytest.fixture
def guarded(monkeypatch: pytest.MonkeyPatch) -> Guarded:
    return Guarded(monkeypatch)


def test_the_controller_is_told_the_time_limit_once(guarded: Guarded) -> None:
    assert guarded.control.frequencies_hz == [1 / WATCHDOG_S]
    guarded.watchdog.guard(guarded.control)  # pyright: ignore[reportArgumentType]
    assert len(guarded.control.frequencies_hz) == 1
    guarded.watchdog.release()
    guarded.control.accepts = False
    with pytest.raises(RuntimeError, match="did not accept its watchdog"):
        guarded.watchdog.guard(guarded.control)  # pyright: ignore[reportArgumentType]
    assert guarded.beat() == 0, "what is not guarded is not kicked"


def test_each_beat_is_one_kick(guarded: Guarded) -> None:
    assert [guarded.beat() for _ in range(3)] == [1, 2, 3]


def test_no_beat_no_kick_and_an_old_beat_is_none(guarded: Guarded) -> None:
    assert guarded.beat(late_s=0.9 * WATCHDOG_S) == 1
    assert guarded.beat(late_s=1.1 * WATCHDOG_S) == 1, "it waited in a queue while its sender may have died"


def test_a_dead_link_is_not_kicked(guarded: Guarded) -> None:
    guarded.sample = None
    assert guarded.beat() == 0
    guarded.sample = sample(driven=False)
    guarded.control.connected = False
    assert guarded.beat() == 0
    guarded.control.connected = True
    assert guarded.beat() == 1


def test_nothing_is_kicked_after_the_release(guarded: Guarded) -> None:
    guarded.watchdog.begin()
    guarded.watchdog.release()
    assert not guarded.watchdog.moving
    assert guarded.beat() == 0
    guarded.control.runs = False
    guarded.watchdog.look()
    assert guarded.held == ""


@pytest.mark.parametrize("driven", [True, False])
def test_a_moving_arm_that_nobody_looks_at_is_not_kicked(guarded: Guarded, driven: bool) -> None:
    guarded.sample = sample(driven=driven)
    assert not guarded.watchdog.moving
    guarded.watchdog.begin()
    assert guarded.watchdog.moving
    guarded.after(UNATTENDED_S - 0.1)
    assert guarded.beat() == 1
    guarded.after(0.2)
    assert guarded.beat() == (1 if driven else 2), "an arm that arrived by itself needs no stop"
    guarded.watchdog.attend()
    assert guarded.beat() == (2 if driven else 3)


def test_an_arm_that_has_arrived_needs_nobody_to_look(guarded: Guarded) -> None:
    guarded.sample = sample(driven=True)
    guarded.watchdog.begin()
    guarded.watchdog.arrive()
    guarded.after(10 * UNATTENDED_S)
    assert guarded.beat() == 1


def test_a_script_that_was_ended_elsewhere_takes_the_leave(guarded: Guarded) -> None:
    guarded.beat()
    guarded.control.runs = False
    guarded.after(0.5 * LATE * WATCHDOG_S)
    guarded.watchdog.look()
    assert "the arm was stopped: its program was ended at the controller" in guarded.held
    assert not guarded.watchdog.lapsed()


def test_a_beat_notices_it_too_and_kicks_nothing(guarded: Guarded) -> None:
    guarded.control.runs = False
    assert guarded.beat() == 0
    assert "ended at the controller" in guarded.held


def test_a_moving_arm_without_kicks_was_stopped_for_want_of_a_sign_of_life(guarded: Guarded) -> None:
    guarded.watchdog.begin()
    guarded.after(0.5)
    guarded.control.runs = False
    guarded.watchdog.look()
    assert "the program that drives it gave no sign of life for 0.5 s" in guarded.held
    assert not guarded.watchdog.lapsed()


def test_a_short_gap_at_rest_is_a_lapse_and_takes_no_leave(guarded: Guarded) -> None:
    guarded.after(LAPSE_S - 0.1)
    guarded.control.runs = False
    assert guarded.watchdog.lapsed()
    assert guarded.held == ""
    guarded.control.runs = True
    guarded.watchdog.guard(guarded.control)  # pyright: ignore[reportArgumentType]
    assert not guarded.watchdog.lapsed(), "the script was sent again"


def test_a_long_gap_takes_the_leave_even_at_rest(guarded: Guarded) -> None:
    guarded.after(LAPSE_S + 0.1)
    guarded.control.runs = False
    assert not guarded.watchdog.lapsed()
    assert "no sign of life for 2.1 s" in guarded.held


def test_an_arm_left_alone_is_told_as_that(guarded: Guarded) -> None:
    guarded.sample = sample(driven=True)
    guarded.watchdog.begin()
    guarded.after(UNATTENDED_S + 0.1)
    guarded.beat()
    guarded.control.runs = False
    guarded.watchdog.look()
    assert "nobody had looked at it for 2 s" in guarded.held


def test_a_gap_explains_an_end_that_shows_only_after_the_next_kick(guarded: Guarded) -> None:
    """The controller's reaction to a gap takes a moment to arrive; the kick meanwhile does not hide the gap."""
    guarded.watchdog.begin()
    guarded.after(0.3)
    guarded.beat()
    guarded.after(watchdog.NEWS_S - 0.1)
    guarded.beat()  # in time or not, the gap before is the newest that counts, or this one
    guarded.control.runs = False
    guarded.watchdog.look()
    assert "gave no sign of life for 0.9 s" in guarded.held


def test_a_gap_of_long_ago_explains_nothing(guarded: Guarded) -> None:
    guarded.watchdog.begin()
    guarded.after(0.5)
    guarded.beat()
    for _ in range(20):
        guarded.after(0.1)
        guarded.beat()
    guarded.control.runs = False
    guarded.watchdog.look()
    assert "ended at the controller" in guarded.held


def test_a_command_counts_as_a_kick(guarded: Guarded) -> None:
    guarded.watchdog.begin()
    guarded.after(0.15)
    with guarded.watchdog.commanding():
        pass
    guarded.after(0.1)
    guarded.control.runs = False
    guarded.watchdog.look()
    assert "ended at the controller" in guarded.held, "0.25 s since the last beat, but 0.1 s since the command"


def test_a_failed_command_that_ended_the_script_is_its_own_explanation(guarded: Guarded) -> None:
    guarded.watchdog.excuse()  # the script runs: nothing to excuse
    assert guarded.beat() == 1
    guarded.control.runs = False
    guarded.watchdog.excuse()
    assert guarded.held == ""
    assert guarded.beat() == 1, "it is guarded no longer"


def test_a_failed_command_is_no_excuse_for_late_kicks(guarded: Guarded) -> None:
    guarded.watchdog.begin()
    guarded.after(0.5)
    guarded.control.runs = False
    guarded.watchdog.excuse()
    assert "gave no sign of life for 0.5 s" in guarded.held


@pytest.mark.parametrize(
    ("bits", "state"),
    [
        (0, SafetyState.UNKNOWN),
        (1, SafetyState.NORMAL),
        (1 << 1 | 1, SafetyState.REDUCED),
        (1 << 2 | 1, SafetyState.PROTECTIVE_STOP),
        (1 << 3, SafetyState.FAULT),
        (1 << 4 | 1 << 2, SafetyState.SAFEGUARD_STOP),
        *((1 << bit | 1 << 4 | 1, SafetyState.EMERGENCY_STOP) for bit in (5, 6, 7)),
        *((1 << bit | 1 << 7 | 1, SafetyState.FAULT) for bit in (8, 9)),
        (1 << 10, SafetyState.UNKNOWN),
    ],
)
def test_the_gravest_safety_state_wins(bits: int, state: SafetyState) -> None:
    assert safety.safety_state(bits) is state
