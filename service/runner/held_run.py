"""A run that this process drives, under its lease; the person who operates it; and the installed software."""

from __future__ import annotations

import functools
import re
import socket
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import Distribution, distributions
from typing import NamedTuple
from typing import Protocol as Interface

from service.core.protocol import Protocol
from service.core.records.events import Payload
from service.core.records.run_events import OperatorAction
from service.core.run.decide import AskOperator
from service.core.run.state import HandWork, RunState
from service.followed_run import RunFollower
from service.monitor.snapshot import Doing
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


# --- the interface through which the runner sees the person who operates the run ----------------------------------


class AnswerBy(NamedTuple):
    """An answer by another person than the run's operator, such as a supervisor at the same terminal."""

    action: OperatorAction
    actor: str


class Operator(Interface):
    """The person who operates the run, or a stand-in on a simulated rig."""

    name: str

    def poll(self, question: AskOperator, state: RunState) -> OperatorAction | AnswerBy | None:
        """Return the answer, if there is one yet; called about ten times per second while a question is open.

        Raises PersonNeededError where nobody attends who could give it.
        """
        ...

    def show(self, what: str, done: int, total: int) -> None:
        """Show the progress of the work."""
        ...

    def tell(self, message: str) -> None:
        """Show one line on what happened."""
        ...

    def busy(self, what: str) -> None:
        """Say what a long call is about to do; screens show it until the next `attend`."""
        ...

    def attend(self, doing: Doing, state: RunState, *, pedal_armed: bool, asked: AskOperator | None = None) -> None:
        """Update what screens show; called several times per second, whatever the runner does."""
        ...

    def stuck(self, why: str, for_s: float) -> None:
        """Called every second while the run cannot go on. Raises PersonNeededError where nobody attends for long."""
        ...

    def ticked(self, question: AskOperator, state: RunState) -> tuple[str, ...]:
        """Return the checklist items that count as done when the foot pedal confirms."""
        ...

    def prepare(self, step: str, attempt: int) -> None:
        """Called before a step begins, so that a simulated technician does what was confirmed as done."""
        ...

    def mend(self, step: str, attempt: int, hands: Sequence[HandWork]) -> None:
        """Called before a confirmed retry, so that a simulated technician does what the step has asked for."""
        ...


# --- the installed software, for the record of a session ----------------------------------------------------------

_FIELDS = re.compile(r"^(Name|Version):[ \t]*(.*?)[ \t]*$", re.MULTILINE)


def software_versions() -> dict[str, str]:
    """Return every installed distribution and its version, sorted by name; as this process found them first."""
    return dict(_installed())


@functools.cache
def _installed() -> tuple[tuple[str, str], ...]:
    found = dict(map(_named, distributions()))
    return tuple((name, version) for name, version in sorted(found.items()) if name)


def _named(distribution: Distribution) -> tuple[str, str]:
    """Return the name and version; the metadata's other fields, which are long, are not parsed."""
    text = distribution.read_text("METADATA") or distribution.read_text("PKG-INFO") or ""
    header = text.replace("\r\n", "\n").partition("\n\n")[0]
    fields = dict(reversed(_FIELDS.findall(header)))
    return fields.get("Name", ""), fields.get("Version", "")
