"""A run that this process drives: read by following its events, written under its lease."""

from __future__ import annotations

import socket
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass

from service.core.protocol.models import Protocol
from service.core.records.events import Payload
from service.core.run.state import RunState
from service.run_record import RunFollower
from service.store.queue.leases import RunLease
from service.store.store import Store

_LEASE_S = 30.0


@dataclass(frozen=True)
class HeldRun:
    """What the runner reads and writes of its run; a write is refused once another process has taken over."""

    store: Store
    follower: RunFollower
    lease: RunLease

    @property
    def state(self) -> RunState:
        """The state as it was read last."""
        return self.follower.state

    def refresh(self) -> RunState:
        """Read what other processes have appended meanwhile. Raises IntegrityError for events that cannot be."""
        return self.follower.refresh()

    def append(self, *payloads: Payload, actor: str = "runner") -> None:
        """Append events in one transaction. Raises LeaseLostError, StoreError."""
        self.store.record(self.follower.run_id, payloads, actor=actor, lease=self.lease)


@contextmanager
def held_run(store: Store, run_id: str, protocol: Protocol) -> Generator[HeldRun]:
    """Hold the lease of a run, renewed all the time, and release it at the end.

    Raises LeaseHeldError where another process that may still live holds it.
    """
    with store.lease(run_id, f"runner on {socket.gethostname()}", _LEASE_S) as lease:
        yield HeldRun(store, RunFollower(store, run_id, protocol), lease)
