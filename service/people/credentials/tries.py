"""Recent failed tries to sign in, from the site's chain, so that a restart does not forget them."""

from __future__ import annotations

from datetime import datetime, timedelta
from math import inf

from sqlalchemy import and_, func, or_, select

from service.core.records.events import Event, SignInRecorded
from service.store.database.tables import event_index, events
from service.store.durable_effects import utc_text
from service.store.events import to_event
from service.store.records import SITE
from service.store.store import Store


def failed_tries(store: Store, window_s: float) -> list[tuple[str, float]]:
    """(address, age in s) of every failed try within the last `window_s` seconds, oldest first.

    A try that seems to be in the future, because the clock was set back, counts as made now. Since the first start of
    the service in the present boot, both clocks must say that a try is old. Raises IntegrityError.
    """
    now, monotonic_s = store.clock.utc_now(), store.clock.monotonic_s()
    place = (event_index.c.run_id == events.c.run_id) & (event_index.c.seq == events.c.seq)
    of_site = select(events).join(event_index, place).where(event_index.c.run_id == SITE)
    boot = store.clock.boot()
    start = of_site.where(
        event_index.c.kind == "service_started", func.json_extract(events.c.payload, "$.boot") == boot
    )
    with store.database.reading() as connection:
        first = connection.execute(start.order_by(events.c.seq).limit(1)).first() if boot else None
        since = inf if first is None else first.seq
        by_utc = events.c.at_utc > utc_text(now - timedelta(seconds=window_s))
        young = by_utc
        if first is not None:
            young = or_(by_utc, and_(events.c.seq > first.seq, events.c.monotonic_s > monotonic_s - window_s))
        recent = of_site.where(event_index.c.kind == "sign_in_recorded", young).order_by(events.c.seq)
        found = [to_event(row) for row in connection.execute(recent)]

    def age_s(event: Event) -> float:
        by_utc_s = (now - datetime.fromisoformat(event.at_utc)).total_seconds()
        return max(0.0, min(by_utc_s, monotonic_s - event.monotonic_s) if event.seq > since else by_utc_s)

    return [
        (event.payload.address, age_s(event))
        for event in found
        if isinstance(event.payload, SignInRecorded) and _is_try(event.payload)
    ]


def _is_try(event: SignInRecorded) -> bool:
    # Events without an address concern a PIN or a signature; that an address has to wait is not a try.
    refused = event.outcome == "refused" or (event.outcome == "locked_out" and event.account != "")
    return refused and event.address != ""
