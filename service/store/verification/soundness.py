"""Verify a chain before it is signed, because a signature would make a forged record look genuine."""

from __future__ import annotations

from sqlalchemy import Connection, bindparam, select

from service.core.errors import IntegrityError
from service.store.database.tables import events
from service.store.events import ROOT
from service.store.store import Store
from service.store.verification.chain_checks import Fault, chain_fault

# Put together once: every signature asks them several times.
_ONE = select(events).where(events.c.run_id == bindparam("run"), events.c.seq == bindparam("last"))
_AFTER = (
    select(events).where(events.c.run_id == bindparam("run"), events.c.seq > bindparam("last")).order_by(events.c.seq)
)


def require_sound(store: Store, connection: Connection, run_id: str) -> None:
    """Raise IntegrityError unless the chain, its earlier signatures and the log of signatures agree.

    Events that this process has verified before are not read again; only the last of them must still be there.

    Args:
        store: remembers how far each chain was verified, and what its last look at the signatures found.
        connection: a connection within a transaction.
        run_id: the chain's run, or SITE.
    """
    found = _chain(store, connection, run_id)
    fault = found if isinstance(found, Fault) else store.seen_signatures.fault(run_id)
    if fault is None and not isinstance(found, Fault):
        store.sound_until[run_id] = found
        return
    store.seen_signatures.forget()  # it may be put right
    raise IntegrityError(
        f"nothing is signed, because the record does not verify: {fault}",
        where=str(store.database_path),
        remedy="Run `orthocapture audit verify`; keep the data folder as it is",
    )


def _chain(store: Store, connection: Connection, run_id: str) -> Fault | tuple[int, str]:
    end = store.sound_until.get(run_id, (0, ROOT))
    place = {"run": run_id, "last": end[0]}
    if end[0]:
        before = connection.execute(_ONE, place).mappings().one_or_none()
        if before is None or before["sha256"] != end[1]:
            return Fault(run_id, end[0], "", "this event is not the one that was here before")
    return chain_fault(run_id, connection.execute(_AFTER, place).mappings(), end)
