"""Results that were planned but had not arrived at an export, according to the record."""

from __future__ import annotations

from collections.abc import Sequence

from service.core.protocol.models import Protocol
from service.core.records.events import Event
from service.core.run.state import RunState


def not_in_yet(protocol: Protocol, state: RunState, events: Sequence[Event]) -> list[str]:
    """Lines such as `COLMAP from scratch: was still being computed`; empty if every result has arrived.

    The same events give the same lines, so the time that is left is not among them.
    """
    from service.steps.due_jobs import missing_results  # noqa: PLC0415 - as in service.run_record

    return [
        f"{left.what}: {f'there will be none, {left.failed}' if left.failed else 'was still being computed'}"
        for left in missing_results(protocol, state, {}, events[-1].at_utc, 1)
    ]
