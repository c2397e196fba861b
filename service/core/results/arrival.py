"""Which results arrived in time; a result that arrives after the specimen was freed says so.

A specimen is freed; a run is released, by a second person, and its data with it (service/core/gates/release.py).
"""

from __future__ import annotations

from datetime import datetime

from service.core.protocol.models import Protocol
from service.core.run.state import RunState

_ANSWERS = ("registrations", "accuracy")  # what must be known before a specimen is freed


def freed_utc(protocol: Protocol, state: RunState) -> str:
    """When the specimen was freed, so that nothing can be measured again (ISO 8601, UTC); "" before that.

    That is when the first irreversible step that requires a registration or an evaluation passed, or else the end of
    the run.
    """
    return _freed_by_step_utc(protocol, state) or (state.ended_utc if state.status == "completed" else "")


def late_s(protocol: Protocol, state: RunState, now_utc: str) -> float | None:
    """Seconds from `freed_utc` to a result that arrives at `now_utc`; None if it is in time."""
    freed = freed_utc(protocol, state)
    if not freed:
        return None
    return max(0.0, (datetime.fromisoformat(now_utc) - datetime.fromisoformat(freed)).total_seconds())


def late_words(protocol: Protocol, state: RunState, seconds: float) -> str:
    """A delay in words, such as `arrived 12 min after the specimen was freed`."""
    since = "the specimen was freed" if _freed_by_step_utc(protocol, state) else "the end of the run"
    minutes = round(seconds / 60)
    return f"arrived {minutes} min after {since}" if minutes else f"arrived after {since}"


def _freed_by_step_utc(protocol: Protocol, state: RunState) -> str:
    for step in protocol.steps:
        rests = any(protocol.step(name).gives in _ANSWERS for name in step.requires)
        if step.irreversible and rests and state.steps[step.id].phase == "passed":
            return state.steps[step.id].ended_utc
    return ""
