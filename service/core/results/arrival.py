"""Which results arrived in time; a result that arrives after the specimen's release says so."""

from __future__ import annotations

from datetime import datetime

from service.core.protocol.models import Protocol
from service.core.run.state import RunState

_ANSWERS = ("registrations", "accuracy")  # what a release depends on


def released_utc(protocol: Protocol, state: RunState) -> str:
    """When the specimen was released, so that nothing can be measured again (ISO 8601, UTC); "" before that.

    That is when the first irreversible step that requires a registration or an evaluation passed, or else the end of
    the run.
    """
    for step in protocol.steps:
        rests = any(protocol.step(name).gives in _ANSWERS for name in step.requires)
        if step.irreversible and rests and state.steps[step.id].phase == "passed":
            return state.steps[step.id].ended_utc
    return state.ended_utc if state.status == "completed" else ""


def late_s(protocol: Protocol, state: RunState, now_utc: str) -> float | None:
    """Seconds from the release to a result that arrives at `now_utc`; None if it is in time."""
    released = released_utc(protocol, state)
    if not released:
        return None
    return max(0.0, (datetime.fromisoformat(now_utc) - datetime.fromisoformat(released)).total_seconds())


def late_words(seconds: float) -> str:
    """A delay in words, such as `arrived 12 min after the release`."""
    minutes = round(seconds / 60)
    return f"arrived {minutes} min after the release" if minutes else "arrived after the release"
