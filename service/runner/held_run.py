"""A run that this process drives: its events are followed, and new ones are written under its lease."""

from __future__ import annotations

import socket
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field

from service.core.protocol import Protocol
from service.core.records.events import Payload
from service.core.run.state import RunState
from service.followed_run import RunFollower
from service.store.runs import RunLease
from service.store.store import Store

_LEASE_S = 30.0
_LOOK_EVERY_S = 1.0  # at what was recorded, while the run only waits or computes


@dataclass(frozen=True)
class HeldRun:
    """The runner's access to its run; writing is refused once another process has taken over."""

    store: Store
    follower: RunFollower
    lease: RunLease
    _looked: list[float] = field(default_factory=lambda: [float("-inf")])  # monotonic time of the last look

    @property
    def state(self) -> RunState:
        """The state as of the last read."""
        return self.follower.state

    def refresh(self) -> RunState:
        """Read what other processes have appended, and once a second make sure that what was recorded is still there.

        Raises IntegrityError for an impossible event, RecordDamagedError if database or journal was altered.
        """
        now_s = self.store.clock.monotonic_s()
        if now_s - self._looked[0] >= _LOOK_EVERY_S:
            self._looked[0] = now_s
            self.store.database.require_record()
        return self.follower.refresh()

    def append(self, *payloads: Payload, actor: str = "runner") -> None:
        """Append events in one transaction. Raises LeaseLostError, StoreError."""
        self.store.record(self.follower.run_id, payloads, actor=actor, lease=self.lease)


@contextmanager
def held_run(store: Store, run_id: str, protocol: Protocol) -> Generator[HeldRun]:
    """Hold the lease of a run, which renews itself, until the end of this block.

    Raises LeaseHeldError if another process, which may still be alive, holds it.
    """
    with store.lease(run_id, f"runner on {socket.gethostname()}", _LEASE_S) as lease:
        yield HeldRun(store, RunFollower(store, run_id, protocol), lease)
