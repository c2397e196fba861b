"""A run as it grows: its events are read, folded and followed while other processes append to them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from threading import Lock

from service.core.protocol import Protocol
from service.core.records.events import Event
from service.core.records.run_events import RecordedView
from service.core.run.decide import advance, fold
from service.core.run.fold import FoldedRun
from service.core.run.state import RunState
from service.store.store import Store


@dataclass(frozen=True, slots=True)
class RunRecord(FoldedRun):
    """The record of one run at one moment, and the store that holds its files and jobs."""

    store: Store

    def captures(self, step_id: str) -> tuple[RecordedView, ...]:
        """Return the valid captures of a step's current attempt, in the order of capture."""
        payloads = (self.events[seq - 1].payload for seq in sorted(self.state.steps[step_id].captured.values()))
        return tuple(payload for payload in payloads if isinstance(payload, RecordedView))


@dataclass
class RunFollower:
    """Follows the events of one run and folds them; several threads may use it.

    An impossible event is not added, so every later `refresh` and `now` raises IntegrityError again.
    `leave_not_before_s` is a monotonic time of the store's clock at which the newest leave was not yet recorded.
    """

    store: Store
    run_id: str
    protocol: Protocol
    leave_not_before_s: float = field(init=False, default=-math.inf)
    _events: list[Event] = field(init=False, default_factory=list[Event], repr=False)
    _state: RunState = field(init=False, repr=False)
    _log: RunRecord | None = field(init=False, default=None, repr=False)  # of the newest state, made on request
    _looked_s: float = field(init=False, default=-math.inf)
    _reading: Lock = field(init=False, default_factory=Lock, repr=False, compare=False)

    def __post_init__(self) -> None:
        self._state = fold(self.protocol, [])
        self.refresh()

    @property
    def state(self) -> RunState:
        """The state as of the last read."""
        return self._state

    def refresh(self) -> RunState:
        """Read what other processes (worker, command line, web) have appended. Raises IntegrityError."""
        with self._reading:
            return self._read()

    def now(self) -> RunRecord:
        """Return the record up to now. Raises IntegrityError for an impossible event."""
        with self._reading:
            state = self._read()
            if self._log is None or self._log.state is not state:
                self._log = RunRecord(self.run_id, self.protocol, tuple(self._events), state, self.store)
            return self._log

    def _read(self) -> RunState:
        leave, looked_s = self._state.leave, self.store.clock.monotonic_s()
        known = len(self._events)
        if self.store.head(self.run_id) != known:  # steps that wait look often, and seldom is anything new
            for event in self.store.events(self.run_id, after_seq=known):
                # Fold first: an event that is refused must not be stored.
                self._state = advance(self.protocol, self._state, event)
                self._events.append(event)
        if self._state.leave != leave:
            self.leave_not_before_s = self._looked_s
        self._looked_s = looked_s
        return self._state


def read_log(store: Store, run_id: str, protocol: Protocol) -> RunRecord:
    """Return a run's record as of now, for a single read. Raises IntegrityError for an impossible event."""
    return RunFollower(store, run_id, protocol).now()
