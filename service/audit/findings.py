"""Corrected values, repeated steps and retaken views of a run, and who signed what with which meaning."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pydantic import TypeAdapter
from sqlalchemy import Connection, text

from service.audit.overview import Digest
from service.audit.queries import EventRow, computed_sha256, one_event, plain, read_rows, seq_of_hash, seqs_of_kind
from service.core.errors import DataError, StoreError
from service.core.gates import quantity, uncertain
from service.core.records.entered import reason_of
from service.core.records.events import Event
from service.core.records.run_events import OperatorAction, RecordCorrected, RunReleased, Uncertainty
from service.core.text_files import parse_json
from service.store.store import Store


@dataclass(frozen=True, slots=True)
class _Measured:
    """The part of a step_measured event that is shown."""

    attempt: int
    measures: Mapping[str, float] = field(default_factory=dict[str, float])
    uncertainties: Mapping[str, Uncertainty] = field(default_factory=dict[str, Uncertainty])

    def texts(self) -> Mapping[str, str]:
        """Return the measures as texts, with their bounds if they have any."""
        known = self.uncertainties
        return {
            name: uncertain(value, known[name].lower, known[name].upper) if name in known else quantity(value)
            for name, value in self.measures.items()
        }


_MEASURED = TypeAdapter(_Measured)
LISTED = 200  # most rows of a list; the timeline has the rest


@dataclass(frozen=True, slots=True)
class CorrectedValue:
    """A correction, and the event that it corrects."""

    seq: int
    at_utc: str
    person: str
    correction: RecordCorrected
    of_kind: str
    original: Any  # the value in the event; equals `correction.old`
    latest: bool  # no later correction of the same value

    @property
    def old_text(self) -> str:
        """The original value as text."""
        return value_text(self.correction.old)

    @property
    def new_text(self) -> str:
        """The new value as text."""
        return value_text(self.correction.new)


def corrected_values(connection: Connection, run_id: str) -> list[CorrectedValue]:
    """Return all corrections of a run, in order."""
    rows = read_rows(
        connection, run_id, seqs_of_kind(connection, run_id, ["record_corrected"], limit=LISTED), whole=True
    )
    made = [(row, correction) for row in rows if (correction := row.record(RecordCorrected)) is not None]
    of = sorted({correction.of_seq for _, correction in made})
    events = {event.seq: event for event in read_rows(connection, run_id, of, whole=True)}
    last = {(correction.of_seq, correction.field): row.seq for row, correction in made}
    found: list[CorrectedValue] = []
    for row, correction in made:
        event = events.get(correction.of_seq)
        found.append(
            CorrectedValue(
                seq=row.seq,
                at_utc=row.at_utc,
                person=row.actor,
                correction=correction,
                of_kind=event.kind if event else "",
                original=value_at(event.payload, correction.field) if event else None,
                latest=last[correction.of_seq, correction.field] == row.seq,
            )
        )
    return found


def value_text(value: Any) -> str:
    """Return a value as text: strings unchanged, anything else as JSON."""
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def value_at(payload: Mapping[str, Any], path: str) -> Any:
    """Return the value at a path such as environment.light_lux or verdicts.0.value; None if there is none."""
    value: Any = payload
    for part in path.split("."):
        if isinstance(value, Mapping) and part in value:
            value = value[part]
        elif isinstance(value, list) and part.isascii() and part.isdigit() and int(part) < len(value):
            value = value[int(part)]
        else:
            return None
    return value


@dataclass(frozen=True, slots=True)
class Attempt:
    """The measures of one attempt of a step."""

    attempt: int
    seq: int
    at_utc: str
    measures: Mapping[str, str]  # measures as text, with bounds if the measure states any


@dataclass(frozen=True, slots=True)
class ReplacedStep:
    """A step that was done more than once, with the measures of every attempt."""

    step: str
    reasons: Sequence[tuple[int, str]]  # event and reason of each superseded attempt
    attempts: Sequence[Attempt]

    @property
    def measures(self) -> list[str]:
        """Every measure of any attempt."""
        return list(dict.fromkeys(name for attempt in self.attempts for name in attempt.measures))


def replaced_steps(connection: Connection, run_id: str, digest: Digest) -> list[ReplacedStep]:
    """Return the steps with a superseded or retried attempt, in the protocol's order."""
    rows = connection.execute(
        text(
            "SELECT e.seq, e.at_utc, i.step, e.payload "
            "FROM event_index AS i JOIN events AS e ON e.run_id = i.run_id AND e.seq = i.seq "
            "WHERE i.run_id = :run AND i.kind = 'step_measured' ORDER BY i.seq DESC LIMIT :limit"
        ),
        {"run": plain(run_id), "limit": LISTED},
    ).all()
    measured: dict[str, list[Attempt]] = {}
    for row in reversed(rows):
        attempt = _MEASURED.validate_json(row.payload)
        measured.setdefault(row.step, []).append(Attempt(attempt.attempt, row.seq, row.at_utc, attempt.texts()))
    if digest.state is None:
        return []
    reasons: dict[str, list[tuple[int, str]]] = {}
    for past in digest.state.superseded:
        if past.viewpoint is None:
            reasons.setdefault(past.step, []).append((past.seq, past.reason))
    return [
        ReplacedStep(name, reasons.get(name, [])[-20:], measured.get(name, [])[-6:])
        for name in digest.state.steps
        if len(measured.get(name, [])) > 1 or name in reasons
    ]


@dataclass(frozen=True, slots=True)
class ReplacedViewpoint:
    """A viewpoint that was retaken: the replaced event, and the one that counts."""

    seq: int  # number of the event that superseded it
    step: str
    viewpoint: str
    reason: str
    old_seq: int
    new_seq: int | None  # None: not retaken yet


def replaced_viewpoints(digest: Digest) -> list[ReplacedViewpoint]:
    """Return all retaken viewpoints, in order."""
    if digest.state is None:
        return []
    return [
        ReplacedViewpoint(
            past.seq,
            past.step,
            past.viewpoint,
            past.reason,
            old,
            digest.state.steps[past.step].captured.get(past.viewpoint),
        )
        for past in digest.state.superseded
        if past.viewpoint is not None
        for old in past.captured.values()
    ]


def events_of(connection: Connection, run_id: str, *kinds: str, newest: bool = False) -> list[EventRow]:
    """Return the events of some kinds with their payloads, LISTED of them at most."""
    seqs = seqs_of_kind(connection, run_id, kinds, limit=LISTED, newest=newest)
    return read_rows(connection, run_id, seqs, whole=True)


_UNCORRECTABLE = frozenset({"sha256", "size_bytes", "kind", "signed_sha256", "protocol_sha256"})
_FIELDS = 300  # offered for choice
_REMEDY = "Open the event in the timeline and copy the name of the field"


def correct(store: Store, run_id: str, *, of_seq: int, field: str, new: str, reason: str, actor: str) -> Event:
    """Append RecordCorrected. The old value is read from the event; the new one is of the same type.

    Raises:
        UnknownRunError: there is no such run or event.
        DataError: the field does not exist or cannot be corrected, the value has another type or is the same, or no
            reason is given.
    """
    field, reason = field.strip(), reason_of(reason, DataError)
    where = f"event {of_seq}, {field}"
    with store.database.reading() as connection:
        event = one_event(connection, run_id, of_seq)
    if event.kind == "record_corrected":
        raise DataError(
            "a correction is not corrected itself", where=where, remedy="Correct the original value once more"
        )
    names = field.split(".")
    missing = object()
    holder: Any = value_at(event.payload, ".".join(names[:-1])) if len(names) > 1 else event.payload
    present = isinstance(holder, dict) and names[-1] in holder
    present = present or (isinstance(holder, list) and value_at(event.payload, field) is not None)
    old = value_at(event.payload, field) if present else missing
    if old is missing:
        raise DataError("the event has no such field", where=where, remedy=_REMEDY)
    if _UNCORRECTABLE & set(names):
        raise DataError("what identifies a record or a file cannot be corrected", where=where, remedy="Redo the step")
    value = _typed(old, new.strip(), where)
    if value == old:
        raise DataError("the new value is the recorded one", where=where, remedy="There is nothing to correct")
    payload = RecordCorrected(of_seq=of_seq, field=field, old=old, new=value, reason=reason)
    (appended,) = store.record(run_id, [payload], actor=actor)
    return appended


def correctable(payload: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the fields that can be corrected, each with its value as text; a few hundred at most."""
    found: list[tuple[str, str]] = []

    def walk(value: Any, path: tuple[str, ...]) -> None:
        if len(found) >= _FIELDS or (path and path[-1] in _UNCORRECTABLE):
            return
        if isinstance(value, dict):
            for name, item in value.items():
                if "." not in name:
                    walk(item, (*path, name))
        elif isinstance(value, list):
            for index, item in enumerate(value):
                walk(item, (*path, str(index)))
        else:
            found.append((".".join(path), value_text(value)))

    walk(dict(payload), ())
    return found


def _typed(old: Any, new: str, where: str) -> Any:
    match old:
        case str():
            return new
        case bool():
            wanted, value = "true or false", {"true": True, "false": False}.get(new.lower())
        case int() | float():
            wanted, value = "a number", _number(new)
        case None:
            wanted, value = "a number, or a text in quotation marks", _json(new)
        case _:
            raise DataError(
                "only single values can be corrected, not a list or a table",
                where=where,
                remedy="Name one value in it",
            )
    if value is None:
        raise DataError(f"the new value must be {wanted}", where=where, remedy="Nothing was recorded; enter it again")
    return value


def _number(text: str) -> float | int | None:
    try:
        value = float(text)
    except ValueError:
        return None
    if not math.isfinite(value):
        return None
    return int(value) if value.is_integer() and abs(value) < 2**53 and "." not in text else value


def _json(text: str) -> str | float | None:
    try:
        value = parse_json(text, name="the new value")
    except DataError:
        return None
    if isinstance(value, str) or (isinstance(value, int | float) and math.isfinite(value)):
        return value
    return None


# --- signatures: who signed what, with which meaning, and whether each is still valid -----------------------------


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
