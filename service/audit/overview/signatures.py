"""Signatures of a run: who signed what, with which meaning, and whether each is still valid."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import Connection, text

from service.audit.overview.digest import Digest
from service.audit.overview.findings import LISTED
from service.audit.record.rows import EventRow, computed_sha256, plain, read_rows, seq_of_hash
from service.core.errors import StoreError
from service.core.records.run_events import OperatorAction, RunReleased


@dataclass(frozen=True, slots=True)
class RecordedSignature:
    """A signature: who signed what, when, with which meaning, and whether it is still valid."""

    seq: int
    at_utc: str
    person: str
    meaning: str
    step: str
    signed_sha256: str
    bound: EventRow | None  # the event with this hash; None: the run has none
    unaltered: bool  # true if the bound event's content still has this hash
    stands: bool | None  # true if it binds the present record of the step; None: not known yet
    refused: bool  # the action had no effect
    known_by: str  # password, pin, badge or claimed; "" if not recorded


def signatures(connection: Connection, run_id: str, digest: Digest | None) -> list[RecordedSignature]:
    """Return all signatures of a run in order, its release included.

    With `digest`, also whether each is still valid.
    """
    seqs = connection.execute(
        text(
            "SELECT i.seq FROM event_index AS i JOIN event_facets AS f ON f.run_id = i.run_id AND f.seq = i.seq "
            "WHERE i.run_id = :run AND i.kind = 'operator_action' AND f.name = 'action' "
            "AND f.value IN ('sign', 'accept') "
            "UNION SELECT seq FROM event_index WHERE run_id = :run AND kind = 'run_released' "
            "ORDER BY 1 LIMIT :limit"
        ),
        {"run": plain(run_id), "limit": LISTED},
    ).scalars()
    return [
        _signature(connection, run_id, row, digest) for row in read_rows(connection, run_id, list(seqs), whole=True)
    ]


def _signature(connection: Connection, run_id: str, row: EventRow, digest: Digest | None) -> RecordedSignature:
    action, release = row.record(OperatorAction), row.record(RunReleased)
    signed = action.signed_sha256 if action else release.signed_sha256 if release else ""
    seq = seq_of_hash(connection, run_id, signed) if signed else None
    # The hash covers the whole payload, however long.
    bound = next(iter(read_rows(connection, run_id, [seq], whole=True)), None) if seq else None
    refused = digest is not None and any(d.seq == row.seq and d.kind == "refused" for d in digest.deviations)
    return RecordedSignature(
        seq=row.seq,
        at_utc=row.at_utc,
        person=row.actor,
        meaning=_meaning(action) if action else release.meaning if release else "",
        step=row.step,
        signed_sha256=signed,
        bound=bound,
        unaltered=bound is not None and _is_unaltered(run_id, bound, signed),
        stands=None
        if digest is None or digest.state is None
        else _stands(digest, row, action, signed) and not refused,
        refused=refused,
        known_by=action.identified if action else release.identified if release else "",
    )


def _meaning(action: OperatorAction) -> str:
    return f"accepted outside its limits: {action.reason}" if action.action == "accept" else action.meaning


def _is_unaltered(run_id: str, bound: EventRow, signed: str) -> bool:
    try:
        return computed_sha256(run_id, bound) == signed
    except StoreError:
        return False


def _stands(digest: Digest, row: EventRow, action: OperatorAction | None, signed: str) -> bool:
    state = digest.state
    assert state is not None  # the caller has checked
    if row.kind == "run_released":
        return state.released_by == row.actor and state.completed_sha256 == signed
    step = state.steps.get(row.step)
    if step is not None and action is not None and action.action == "accept":
        return step.accepted is not None and step.accepted.seq == row.seq
    if step is None or not step.signed or step.signed_by != row.actor:
        return False
    # A step binds its gates; that of an irreversible step binds what passed before it.
    return signed in {step.gates_sha256, *(other.passed_sha256 for other in state.steps.values())}
