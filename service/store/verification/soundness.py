"""Verify a chain before it is signed, because a signature would make a forged record look genuine."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import Connection, select

from service.core.errors import IntegrityError
from service.store.database.tables import checkpoints, events
from service.store.events import ROOT
from service.store.records import SITE
from service.store.signatures.checkpoints import read_checkpoints
from service.store.signatures.log import NAME, LogLine
from service.store.store import Store
from service.store.verification.chain_checks import Fault, chain_fault


def require_sound(store: Store, connection: Connection, run_id: str, lines: Sequence[LogLine] | None) -> None:
    """Raise IntegrityError unless the chain, its earlier signatures and the log of signatures agree.

    Events that this process has verified before are not read again; only the last of them must still be there.

    Args:
        store: remembers how far each chain was verified.
        connection: within the transaction that signs.
        run_id: the chain's run, or SITE.
        lines: lines of the log of signatures; None if there is no log.
    """
    found = _chain(store, connection, run_id)
    fault = found if isinstance(found, Fault) else _signature_fault(connection, run_id, lines)
    if fault is None and not isinstance(found, Fault):
        store.sound_until[run_id] = found
        return
    raise IntegrityError(
        f"nothing is signed, because the record does not verify: {fault}",
        where=str(store.database_path),
        remedy="Run `orthocapture audit verify`; keep the data folder as it is",
    )


def _chain(store: Store, connection: Connection, run_id: str) -> Fault | tuple[int, str]:
    end = store.sound_until.get(run_id, (0, ROOT))
    rows = select(events).where(events.c.run_id == run_id).order_by(events.c.seq)
    if end[0]:
        before = connection.execute(rows.where(events.c.seq == end[0])).mappings().one_or_none()
        if before is None or before["sha256"] != end[1]:
            return Fault(run_id, end[0], "", "this event is not the one that was here before")
    return chain_fault(run_id, connection.execute(rows.where(events.c.seq > end[0])).mappings(), end)


def _signature_fault(connection: Connection, run_id: str, lines: Sequence[LogLine] | None) -> Fault | None:
    """A disagreement of a chain's earlier signatures with their events or with the log of signatures, or None."""
    of_event = (events.c.run_id == checkpoints.c.run_id) & (events.c.seq == checkpoints.c.seq)
    joined = select(checkpoints.c.seq).outerjoin_from(checkpoints, events, of_event)
    other = joined.where(checkpoints.c.run_id == run_id, events.c.sha256.is_distinct_from(checkpoints.c.sha256))
    wrong = connection.execute(other.limit(1)).scalar()
    if wrong is not None:
        return Fault(run_id, wrong, "", "a signature is for another event than the one that is here")
    has_signed = select(events.c.seq).where(events.c.run_id == SITE, events.c.kind == "key_changed").limit(1)
    if lines is None and connection.execute(has_signed).first() is not None:
        return Fault(None, None, NAME, "the log of signatures is missing: it was removed")
    signed = {item.seq: item for item in read_checkpoints(connection, run_id)}
    for line in lines or ():
        if line.checkpoint is None or line.problem:
            return Fault(None, None, f"{NAME}, line {line.number}", line.problem)
        if line.checkpoint.run_id == run_id and signed.get(line.checkpoint.seq) != line.checkpoint:
            return Fault(
                run_id, line.checkpoint.seq, "", f"{NAME} holds another signature of this event, or one more"
            )
    return None
