"""How long a person's confirmation lets the arm set out: while something visible comes of it, and a minute longer."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from drivers.errors import LeaveNeededError
from service.core.protocol import Protocol
from service.core.records.base import Moment, elapsed
from service.core.records.run_events import LeaveLapsed
from service.core.run.expected import failed_words
from service.core.run.state import Leave, RunState
from service.monitor.reporter import processor_s
from service.monitor.snapshot import living_workers
from service.runner.held_run import HeldRun
from service.steps.context import StepInterruptedError
from service.store.durable_effects import Clock, moment_of

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
