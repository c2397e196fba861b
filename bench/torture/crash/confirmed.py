"""Return whether a person had let the arm move at some moment, from the events of its run."""

from __future__ import annotations

from collections.abc import Sequence

from service.core.protocol import Protocol
from service.core.records.events import Event
from service.core.records.run_events import OperatorAction, SessionStarted


def confirmed(events: Sequence[Event], protocol: Protocol, monotonic_s: float) -> bool:
    """Say whether a person had confirmed a step with motions since the program that drove the run started."""
    moving = {step.id for step in protocol.steps if step.moves_robot}
    leave = False
    for event in events:
        if event.monotonic_s > monotonic_s:
            break
        if isinstance(event.payload, SessionStarted):
            leave = False
        elif isinstance(event.payload, OperatorAction) and event.payload.action == "confirm":
            leave = leave or (event.payload.step in moving and not event.payload.automatic)
    return leave
