"""Log recorded events in the process that recorded them: one line per event, once it is durable."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from service.core.records.events import Event

_log = logging.getLogger(__name__)
_FIELDS = ("step", "attempt", "viewpoint", "device", "job", "job_kind", "duration_s", "note", "error")


def tell(events: Sequence[Event]) -> None:
    """Log one line per event: its kind, number and actor, what it concerns, and an error's message."""
    if not _log.isEnabledFor(logging.INFO):
        return
    for event in events:
        payload = event.payload
        said = {name: getattr(payload, name) for name in _FIELDS if getattr(payload, name, None) is not None}
        words = getattr(payload, "message", None)
        _log.info(
            "%s",
            payload.kind,
            extra={"run": event.run_id, "seq": event.seq, "actor": event.actor, **said}
            | ({"words": words} if words else {}),
        )
