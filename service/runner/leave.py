"""The leave to move: how a foot pedal gives it, and how long a person's confirmation lets the arm set out."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from drivers.errors import DeviceError, LeaveNeededError
from drivers.interfaces import PedalReading
from service.core.protocol import Protocol
from service.core.records.base import Moment, elapsed
from service.core.records.run_events import LeaveLapsed
from service.core.run.decide import AskOperator
from service.core.run.expected import failed_words
from service.core.run.state import Leave, RunState
from service.monitor.reporter import processor_s
from service.monitor.snapshot import living_workers
from service.runner.held_run import HeldRun
from service.steps.context import StepInterruptedError
from service.store.durable_effects import Clock, moment_of

# --- confirmation by foot pedal: one press if nothing moves, two presses within seconds if the robot will move ----
#
# What is read from the box may be wrong or late, and a robot moves by it. So a press is a count that is one more
# than before, and nothing else; a press that lets the robot move is timed by the box, and its time must fit what
# the host has read before; and as soon as a reading is late the pedal is disarmed.

_RETRY_S = 30.0
# If the robot will move, one press arms the pedal and a second one, this many seconds after it, confirms; on a screen
# the button is held instead. A press that comes sooner may be a bounce of the contact or a slip of the foot.
SECOND_PRESS_S = (0.5, 6.0)
LATE_S = 0.5  # between two readings, five times the usual: presses that lie between cannot be distinguished
CLOCKS_DIFFER_S = 0.25  # by how much the box's clock and the host's may differ between two readings


@dataclass(frozen=True, slots=True)
class _Looked:
    """A reading, and when it was made by the host's clock."""

    reading: PedalReading
    at_s: float


@dataclass
class Pedal:
    """Turns the light box's count of presses into confirmations of the open question.

    `read` returns the count since the box was switched on, None without a box, and may raise DeviceError. A press
    confirms only the question that was open at the time: the first call for a question only reads the count.
    """

    read: Callable[[], PedalReading | None]
    monotonic_s: Callable[[], float]
    tell: Callable[[str], None]
    _question: AskOperator | None = field(init=False, default=None)
    _last: _Looked | None = field(init=False, default=None)  # None until the first call for the open question
    _armed_by_s: float | None = field(init=False, default=None)  # the press that armed the pedal, by the box's clock
    _armed_at_s: float = field(init=False, default=0.0)  # when that was read
    _silent_until_s: float = field(init=False, default=0.0)
    _told: str = field(init=False, default="")  # why the pedal does not work, reported once until it works again

    @property
    def armed(self) -> bool:
        """True if a second press would let the robot move."""
        return self._armed_by_s is not None

    def confirms(self, question: AskOperator, *, moves_robot: bool) -> bool:
        """Return whether the pedal has confirmed the question since the last call; call it while it is open."""
        if question != self._question:
            self._question, self._last, self._armed_by_s = question, None, None
        before = self._last
        self._last = now = self._looked()
        if self.armed and (now is None or now.at_s - self._armed_at_s > SECOND_PRESS_S[1]):
            self._armed_by_s = None
        if now is None or before is None:
            return False
        if now.reading.presses == before.reading.presses:
            self._in_time(before, now)
            return False
        if now.reading.presses != before.reading.presses + 1:
            fewer = now.reading.presses < before.reading.presses  # a box that was switched off counts from zero
            self._disarm(
                "the light box was switched off and on" if fewer else "the pedal counts more than one press at once"
            )
            return False
        if "confirm" not in question.options:
            return False
        return self._lets_move(before, now) if moves_robot else True

    def _lets_move(self, before: _Looked, now: _Looked) -> bool:
        """Return whether this press is the second of two. `now` counts one press more than `before`."""
        pressed_s = now.reading.pressed_s
        if pressed_s is None or now.reading.now_s is None:
            self._tell_once(
                "the pedal cannot let the robot move: a light box before firmware 1.4 does not time its presses. "
                "Confirm on the screen"
            )
            return False
        prompt = self._in_time(before, now)  # otherwise this press is a first one at most
        since_last_s = now.at_s - before.at_s + CLOCKS_DIFFER_S
        if not 0.0 <= now.reading.now_s - pressed_s <= since_last_s:
            self._disarm("the time of the press does not fit")
            return False
        earliest_s, latest_s = SECOND_PRESS_S
        if prompt and self._armed_by_s is not None and earliest_s <= pressed_s - self._armed_by_s <= latest_s:
            self._armed_by_s = None
            return True
        self._armed_by_s, self._armed_at_s = pressed_s, now.at_s
        self.tell(f"pedal: press again within {latest_s:.0f} s to let the robot move")
        return False

    def _in_time(self, before: _Looked, now: _Looked) -> bool:
        """Return whether a reading came in time, by both clocks; otherwise disarm the pedal."""
        by_host_s = now.at_s - before.at_s
        if by_host_s > LATE_S:
            self._disarm(f"the light box answered {by_host_s:.1f} s after the reading before")
            return False
        then_s, now_s = before.reading.now_s, now.reading.now_s
        if then_s is not None and now_s is not None and abs(now_s - then_s - by_host_s) > CLOCKS_DIFFER_S:
            self._disarm("the light box's clock jumped")
            return False
        return True

    def _disarm(self, why: str) -> None:
        if self.armed:
            self.tell(f"pedal: {why}; press twice again to let the robot move")
        self._armed_by_s = None

    def _looked(self) -> _Looked | None:
        """Read the count; None without a box, or while it does not work."""
        if self.monotonic_s() < self._silent_until_s:
            return None
        try:
            reading = self.read()
        except DeviceError as error:
            self._silent_until_s = self.monotonic_s() + _RETRY_S
            self._tell_once(f"the foot pedal does not work: {error}")
            return None
        if reading is None:
            return None
        if self._told.startswith("the foot pedal does not work"):
            self._told = ""
        return _Looked(reading, self.monotonic_s())

    def _tell_once(self, words: str) -> None:
        if words != self._told:
            self._told = words
            self.tell(words)


# --- how long a confirmation lasts: while something visible comes of it, and a minute longer ----------------------

_WORKERS_EVERY_S = 2.0


@dataclass
class LeaveWatch:
    """Measures the time without visible progress since a person let the robot move; used by the runner's thread.

    Progress is a count on the screen that has not been as high since then. A failure, a new attempt, a device that
    is opened again are none. While the arm moves, while this thread computes or waits for a processor, and while a
    living worker computes what the step waits for, the time does not count. Where the two clocks of the host
    contradict each other, the confirmation is over: nobody can say how old it is.
    """

    run: HeldRun
    protocol: Protocol
    data: Path
    clock: Clock
    tell: Callable[[str], None]
    busy_s: Callable[[], float] = processor_s
    _leave: Leave | None = field(init=False, default=None)
    _looked: Moment = field(init=False)  # when the newest leave was not yet in the record
    _mark: Moment = field(init=False)  # up to which the time is accounted for
    _busy_s: float = field(init=False)  # then
    _idle_s: float = field(init=False, default=0.0)
    _excused_s: float = field(init=False, default=0.0)
    _unknown: str = field(init=False, default="")  # why the time is not known
    _most: dict[str, int] = field(init=False, default_factory=dict[str, int])  # count → the highest since the leave
    _waits: bool = field(init=False, default=False)  # the time before the mark was a wait for results
    _workers: tuple[float, bool] = field(init=False, default=(float("-inf"), False))  # look again at; one lives

    def __post_init__(self) -> None:
        self._looked = self._mark = moment_of(self.clock)
        self._busy_s = self.busy_s()

    def given_here(self) -> None:
        """Call before an action is recorded that this process took: its person decided now, not at the last look."""
        self._looked = moment_of(self.clock)

    def look(self, state: RunState) -> None:
        """Begin to measure when there is a new leave. Call it with each state that was read."""
        if state.leave is not None and state.leave != self._leave:
            self._mark, self._most = self._looked, {}
            self._begin_anew()
        self._leave = state.leave
        self._looked = moment_of(self.clock)

    def progress(self, what: str, done: int) -> None:
        """Note what the screen shows now."""
        if done > self._most.get(what, 0):
            self._most[what] = done
            self._mark = moment_of(self.clock)
            self._begin_anew()

    def attempt(self) -> None:
        """Call when a step begins or goes on."""
        self._account(counts=True)

    def lapsed(self, state: RunState) -> bool:
        """Return whether the leave is over; if so, record it. Only for steps that move the robot."""
        if state.leave is None or not self.protocol.step(state.current).moves_robot:
            return False
        self._account(counts=True)
        if self._idle_s <= self.protocol.motion.confirmed_for_s and not self._unknown:
            return False
        tries = state.step.tries
        self.end(state, self._unknown or ("" if tries is None else failed_words(tries)))
        return True

    def end(self, state: RunState, why: str) -> None:
        """Record that the leave is over, if there is one, of a step that moves the robot."""
        if state.leave is not None and self.protocol.step(state.current).moves_robot:
            limit_s = self.protocol.motion.confirmed_for_s
            self.run.append(LeaveLapsed(leave_seq=state.leave.seq, idle_s=self._idle_s, limit_s=limit_s, why=why))

    @contextmanager
    def motion(self) -> Generator[None]:
        """Surrounds each motion, whose time does not count. Raises StepInterruptedError if the leave is over.

        Raises LeaveNeededError if there is none.
        """
        state = self.run.refresh()
        self.look(state)
        if state.leave is None:
            raise LeaveNeededError("nobody has let the robot move", where=state.current, remedy="Confirm the step")
        if self.lapsed(state):
            raise StepInterruptedError("the robot does not set out: the confirmation was too long ago")
        if self._idle_s + self._excused_s > self.protocol.motion.confirmed_for_s:
            self.tell(
                f"the robot sets out {self._idle_s + self._excused_s:.0f} s after the last progress: for "
                f"{self._excused_s:.0f} s of that the computer computed, or waited for a processor"
            )
        try:
            yield
        finally:
            self._account(counts=False, excused=False)

    def wait_for_results(self, seconds: float) -> None:
        """Sleep while a step waits for its jobs, which is progress while a worker lives."""
        if not self._waits:
            self._account(counts=True)
        self.clock.sleep(seconds)
        self._account(counts=not self._worker_lives())
        self._waits = True

    def _begin_anew(self) -> None:
        self._busy_s, self._idle_s, self._excused_s, self._unknown, self._waits = self.busy_s(), 0.0, 0.0, "", False

    def _account(self, *, counts: bool, excused: bool = True) -> None:
        """Add the time since the mark to that without progress, or to what excuses it."""
        now, busy_s = moment_of(self.clock), self.busy_s()
        passed = elapsed(self._mark, now)
        if passed.seconds is None:
            self._unknown = self._unknown or passed.why
        else:
            idle_s = max(0.0, passed.seconds - (busy_s - self._busy_s)) if counts else 0.0
            self._idle_s += idle_s
            self._excused_s += passed.seconds - idle_s if excused else 0.0
        self._mark, self._busy_s, self._waits = now, busy_s, False

    def _worker_lives(self) -> bool:
        again_s, lives = self._workers
        if self.clock.monotonic_s() >= again_s:
            lives = bool(living_workers(self.data, self.clock))
            self._workers = (self.clock.monotonic_s() + _WORKERS_EVERY_S, lives)
        return lives
