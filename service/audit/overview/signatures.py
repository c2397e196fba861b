"""Signatures of a run: who signed what with which meaning, and whether each still stands."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import Connection, text

from service.audit.overview.digest import Digest
from service.audit.overview.findings import LISTED
from service.audit.record.queries import (
    EventRow,
    computed_sha256,
    plain,
    read_rows,
    seq_of_hash,
)
from service.core.errors import StoreError


@dataclass(frozen=True, slots=True)
class Signature:
    """Who signed what, when, in what meaning, and whether it still stands."""

    seq: int
    at_utc: str
    person: str
    meaning: str
    step: str
    signed_sha256: str
    bound: EventRow | None  # the event that has this hash; None: no event of the run has it
    unaltered: bool  # the bound event's content gives this hash today
    stands: bool | None  # it is the record on which the step stands now; None: cannot be told yet
    refused: bool  # it had no effect
    known_by: str  # password, pin, badge, claimed; "" where the record does not tell


def signatures(connection: Connection, run_id: str, digest: Digest | None) -> list[Signature]:
    """All of a run, its release included, in order. With `digest`, whether each one still stands."""
    # The word narrows the actions down before any payload is read.
    seqs = connection.execute(
        text(
            "SELECT i.seq FROM event_index AS i JOIN events AS e ON e.run_id = i.run_id AND e.seq = i.seq "
            "WHERE i.run_id = :run AND i.kind = 'operator_action' AND i.position IN "
            '(SELECT rowid FROM event_words WHERE event_words MATCH \'"sign" OR "accept"\') '
            "AND json_extract(e.payload, '$.action') IN ('sign', 'accept') "
            "UNION SELECT seq FROM event_index WHERE run_id = :run AND kind = 'run_released' "
            "ORDER BY 1 LIMIT :limit"
        ),
        {"run": plain(run_id), "limit": LISTED},
    ).scalars()
    return [_signature(connection, run_id, row, digest) for row in read_rows(connection, run_id, list(seqs))]


def _signature(connection: Connection, run_id: str, row: EventRow, digest: Digest | None) -> Signature:
    signed = str(row.payload.get("signed_sha256", ""))
    seq = seq_of_hash(connection, run_id, signed) if signed else None
    # The hash covers the whole payload, however long.
    bound = next(iter(read_rows(connection, run_id, [seq], whole=True)), None) if seq else None
    refused = digest is not None and any(d.seq == row.seq and d.kind == "refused" for d in digest.deviations)
    return Signature(
        seq=row.seq,
        at_utc=row.at_utc,
        person=row.actor,
        meaning=_meaning(row),
        step=row.step,
        signed_sha256=signed,
        bound=bound,
        unaltered=bound is not None and _is_unaltered(run_id, bound, signed),
        stands=None if digest is None or digest.state is None else _stands(digest, row, signed) and not refused,
        refused=refused,
        known_by=str(row.payload.get("identified", "")),
    )


def _meaning(row: EventRow) -> str:
    if row.payload.get("action") == "accept":
        return f"accepted outside its limits: {row.payload.get('reason', '')}"
    return str(row.payload.get("meaning", ""))


def _is_unaltered(run_id: str, bound: EventRow, signed: str) -> bool:
    try:
        return computed_sha256(run_id, bound) == signed
    except StoreError:
        return False


def _stands(digest: Digest, row: EventRow, signed: str) -> bool:
    state = digest.state
    assert state is not None  # the caller has looked
    if row.kind == "run_released":
        return state.released_by == row.actor and state.completed_sha256 == signed
    step = state.steps.get(row.step)
    if step is not None and row.payload.get("action") == "accept":
        return step.accepted is not None and step.accepted.seq == row.seq
    if step is None or not step.signed or step.signed_by != row.actor:
        return False
    # A step binds its gates; the release of an irreversible step binds what passed before it.
    return signed in {step.gates_sha256, *(other.passed_sha256 for other in state.steps.values())}
