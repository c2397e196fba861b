"""A run as it was read: its events and their fold under its protocol."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from service.core.errors import IntegrityError
from service.core.protocol.models import Protocol
from service.core.records.events import Event, RunStarted
from service.core.run.state import RunState


@dataclass(frozen=True, slots=True)
class FoldedRun:
    """The events of one run at one moment and their fold, which belong together."""

    run_id: str
    protocol: Protocol
    events: Sequence[Event]
    state: RunState

    @property
    def root(self) -> RunStarted:
        """The run's first event. Raises IntegrityError if it is not run_started."""
        root = self.events[0].payload if self.events else None
        if not isinstance(root, RunStarted):
            raise IntegrityError("the run's first event is not run_started", where=self.run_id)
        return root
