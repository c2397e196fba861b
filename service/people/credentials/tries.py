"""Recent failed tries to sign in, from the site's chain, so that a restart does not forget them."""

from __future__ import annotations

from datetime import datetime, timedelta

from sqlalchemy import select

from service.core.records.events import SignInRecorded
from service.store.database.tables import event_index, events
from service.store.durable_effects import utc_text
from service.store.events import to_event
from service.store.records import SITE
from service.store.store import Store


def failed_tries(store: Store, window_s: float) -> list[tuple[str, float]]:
    """(address, age in s) of every failed try within the last `window_s` seconds, oldest first.

    A try that seems to be in the future, because the clock was set back, counts as made now. Raises IntegrityError.
    """
    now = store.clock.utc_now()
    recent = (
        select(events)
        .join(event_index, (event_index.c.run_id == events.c.run_id) & (event_index.c.seq == events.c.seq))
        .where(
            event_index.c.run_id == SITE,
            event_index.c.kind == "sign_in_recorded",
            events.c.at_utc > utc_text(now - timedelta(seconds=window_s)),
        )
        .order_by(events.c.seq)
    )
    with store.database.reading() as connection:
        found = [to_event(row) for row in connection.execute(recent)]
    return [
        (event.payload.address, max(0.0, (now - datetime.fromisoformat(event.at_utc)).total_seconds()))
        for event in found
        if isinstance(event.payload, SignInRecorded) and _is_try(event.payload)
    ]


def _is_try(event: SignInRecorded) -> bool:
    # Events without an address concern a PIN or a signature; that an address has to wait is not a try.
    refused = event.outcome == "refused" or (event.outcome == "locked_out" and event.account != "")
    return refused and event.address != ""
