"""Which runs go on in another record: a run's chain lives in one database at a time, as the site's chain says."""

from __future__ import annotations

from pydantic import ValidationError
from sqlalchemy import Connection, and_, bindparam, select
from sqlalchemy.exc import NoResultFound

from service.core.errors import IntegrityError, StoreError
from service.core.records.events import RunMoved
from service.store.database.tables import event_facets, event_index, events
from service.store.event_index import OF_FACET
from service.store.records import SITE

_OF_MOVES = and_(event_facets.c.name == "moved_run", event_facets.c.run_id == SITE)
# Whether the site's chain says where a run goes on, or that it came here. Each append asks it together with its head.
NAMED = select(event_facets.c.seq).where(_OF_MOVES, event_facets.c.value == bindparam("run")).exists()
# The last event of the site's chain that names a run decides.
_LAST = (
    select(event_index.c.seq, event_index.c.kind)
    .join(event_facets, OF_FACET)
    .where(_OF_MOVES, event_facets.c.value == bindparam("run"))
    .order_by(event_index.c.seq.desc())
    .limit(1)
)
_EVERY = (
    select(event_facets.c.value, event_index.c.kind)
    .join(event_index, OF_FACET)
    .where(_OF_MOVES)
    .order_by(event_index.c.seq)
)
_PAYLOAD = select(events.c.payload).where(events.c.run_id == SITE, events.c.seq == bindparam("seq"))


def moved_to(connection: Connection, run_id: str) -> RunMoved | None:
    """Return where a run goes on, if that is in another record. Raises IntegrityError if its event was altered."""
    last = connection.execute(_LAST, {"run": run_id}).first()
    if last is None or last.kind != "run_moved":
        return None
    try:
        return RunMoved.model_validate_json(connection.execute(_PAYLOAD, {"seq": last.seq}).scalar_one())
    except (ValidationError, NoResultFound) as error:
        raise IntegrityError(
            "the event that says where this run went cannot be read",
            where=f"{SITE}, event {last.seq}",
            remedy="Run `orthocapture audit verify all`; nothing is appended to this run",
        ) from error


def moved_runs(connection: Connection) -> frozenset[str]:
    """Return the runs that go on in other records."""
    last = {str(run): str(kind) for run, kind in connection.execute(_EVERY)}
    return frozenset(run for run, kind in last.items() if kind == "run_moved")


def require_here(connection: Connection, run_id: str) -> None:
    """Raise StoreError if a run goes on in another record."""
    moved = None if run_id == SITE else moved_to(connection, run_id)
    if moved is not None:
        raise StoreError(
            f"this run was moved and goes on in {moved.database}: nothing is recorded of it here",
            where=f"run {run_id}, event {moved.seq}",
            remedy=f"Go on there (--data {moved.target}), or move it back: orthocapture store copy FROM TO --run RUN",
        )
