"""How long the work of each step took in earlier runs of a protocol, read from the record of the site."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import select

from service.core.records.events import RunStarted
from service.core.run.expected import EarlierTimes
from service.store.database.tables import event_index, events
from service.store.store import Store

_RUNS = 10  # earlier runs that are looked at, the latest ones
_BEGINS, _ENDS = ("step_started", "step_retried"), "step_measured"
# A person paused the work or had a part of it done again: such an attempt does not tell how long it takes.
_INTERRUPTS = ("operator_action", "leave_lapsed")


def read_step_times(store: Store, run_id: str) -> EarlierTimes:
    """Seconds from the beginning of each step's work to its figures, in the earlier runs of the run's protocol.

    Runs of a simulated rig tell nothing of a real one, nor the other way round. Raises StoreError.
    """
    mine = store.first_event(run_id).payload
    assert isinstance(mine, RunStarted)  # checked when the run was read
    names = [row.run_id for row in store.runs() if row.simulated == mine.simulated]
    before = names[: names.index(run_id)] if run_id in names else names
    earlier: list[str] = []
    for name in reversed(before):
        root = store.first_event(name).payload
        if isinstance(root, RunStarted) and (root.protocol_id, root.origin) == (mine.protocol_id, mine.origin):
            earlier.append(name)
        if len(earlier) == _RUNS:
            break
    times: dict[str, list[float]] = {}
    began: dict[str, datetime] = {}
    of_event = (events.c.run_id == event_index.c.run_id) & (events.c.seq == event_index.c.seq)
    found = (
        select(event_index.c.run_id, event_index.c.kind, event_index.c.step, events.c.at_utc)
        .join(events, of_event)
        .where(event_index.c.run_id.in_(earlier), event_index.c.kind.in_((*_BEGINS, _ENDS, *_INTERRUPTS)))
        .order_by(event_index.c.position)
    )
    with store.database.reading() as connection:
        for row in connection.execute(found):
            at = datetime.fromisoformat(row.at_utc)
            if row.kind in _BEGINS:
                began[row.run_id] = at
            elif (since := began.pop(row.run_id, None)) is not None and row.kind == _ENDS and at >= since:
                times.setdefault(row.step, []).append((at - since).total_seconds())
    return times
