"""Single sections of an auditor's view of a run: signatures, corrections, devices, clocks, releases, exports."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, text

from service.audit.overview.digest import Digest
from service.audit.record.queries import (
    EventRow,
    computed_sha256,
    plain,
    read_rows,
    seq_of_hash,
    seqs_of_kind,
)
from service.core.errors import StoreError
from service.core.gates.verdict import quantity, uncertain

LISTED = 200  # of what is listed whole; the timeline has the rest


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


@dataclass(frozen=True, slots=True)
class CorrectedValue:
    """One correction: the original beside the new value."""

    seq: int
    at_utc: str
    person: str
    of_seq: int
    of_kind: str
    field: str
    old: Any
    new: Any
    reason: str
    original: Any  # what the event really holds: equals `old`
    latest: bool  # no later correction of the same value

    @property
    def old_text(self) -> str:
        """The original for people."""
        return value_text(self.old)

    @property
    def new_text(self) -> str:
        """The new value for people."""
        return value_text(self.new)


def corrected_values(connection: Connection, run_id: str) -> list[CorrectedValue]:
    """All corrections of a run, in order."""
    rows = read_rows(connection, run_id, seqs_of_kind(connection, run_id, ["record_corrected"], limit=LISTED))
    of = {int(row.payload["of_seq"]) for row in rows}
    events = {event.seq: event for event in read_rows(connection, run_id, sorted(of), whole=True)}
    last = {(row.payload["of_seq"], row.payload["field"]): row.seq for row in rows}
    found: list[CorrectedValue] = []
    for row in rows:
        p = row.payload
        event = events.get(int(p["of_seq"]))
        found.append(
            CorrectedValue(
                seq=row.seq,
                at_utc=row.at_utc,
                person=row.actor,
                of_seq=int(p["of_seq"]),
                of_kind=event.kind if event else "",
                field=str(p["field"]),
                old=p["old"],
                new=p["new"],
                reason=str(p["reason"]),
                original=value_at(event.payload, str(p["field"])) if event else None,
                latest=last[p["of_seq"], p["field"]] == row.seq,
            )
        )
    return found


def value_text(value: Any) -> str:
    """A value for people: text as it is, anything else as JSON."""
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def value_at(payload: Mapping[str, Any], path: str) -> Any:
    """The value at a path such as environment.light_lux or verdicts.0.value; None when there is nothing."""
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
    """What one attempt of a step measured."""

    attempt: int
    seq: int
    at_utc: str
    measures: Mapping[str, str]  # as people read them, with their bounds where they state any


@dataclass(frozen=True, slots=True)
class ReplacedStep:
    """A step that was done more than once: the old measures beside the new."""

    step: str
    reasons: Sequence[tuple[int, str]]  # event that superseded an attempt, and why
    attempts: Sequence[Attempt]

    @property
    def measures(self) -> list[str]:
        """Every measure of any attempt."""
        return list(dict.fromkeys(name for attempt in self.attempts for name in attempt.measures))


def replaced_steps(connection: Connection, run_id: str, digest: Digest) -> list[ReplacedStep]:
    """The steps with a superseded or retried attempt, in the protocol's order."""
    rows = connection.execute(
        text(
            "SELECT e.seq, e.at_utc, i.step, json_extract(e.payload, '$.attempt') AS attempt, "
            "json_extract(e.payload, '$.measures') AS measures, "
            "json_extract(e.payload, '$.uncertainties') AS uncertainties "
            "FROM event_index AS i JOIN events AS e ON e.run_id = i.run_id AND e.seq = i.seq "
            "WHERE i.run_id = :run AND i.kind = 'step_measured' ORDER BY i.seq DESC LIMIT :limit"
        ),
        {"run": plain(run_id), "limit": LISTED},
    ).all()
    measured: dict[str, list[Attempt]] = {}
    for row in reversed(rows):
        measured.setdefault(row.step, []).append(
            Attempt(row.attempt, row.seq, row.at_utc, _numbers(row.measures, row.uncertainties))
        )
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


def _numbers(measures: str | None, uncertainties: str | None) -> Mapping[str, str]:
    known: Mapping[str, Mapping[str, float]] = json.loads(uncertainties or "{}")
    values: Mapping[str, float] = json.loads(measures or "{}")
    return {
        name: uncertain(value, known[name]["lower"], known[name]["upper"]) if name in known else quantity(value)
        for name, value in values.items()
    }


@dataclass(frozen=True, slots=True)
class ReplacedViewpoint:
    """A viewpoint taken again: which event it was, which one counts now."""

    seq: int  # of what superseded it
    step: str
    viewpoint: str
    reason: str
    old_seq: int
    new_seq: int | None  # None: not taken again yet


def replaced_viewpoints(digest: Digest) -> list[ReplacedViewpoint]:
    """All, in order."""
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


@dataclass(frozen=True, slots=True)
class ClockSeries:
    """How a device's clock stood against the host's over a step."""

    step: str
    captures: int
    first_s: float
    last_s: float
    smallest_s: float
    largest_s: float
    over_s: float  # host time between the first and the last

    @property
    def drift_s(self) -> float:
        """Change from the first capture to the last."""
        return self.last_s - self.first_s


def clock_offsets(connection: Connection, run_id: str) -> list[ClockSeries]:
    """The robot controller's clock minus the host's monotonic one, as every capture recorded it."""
    rows = connection.execute(
        text(
            "WITH c AS (SELECT i.step, i.seq, e.monotonic_s AS at, json_extract(e.payload, '$.clock_offset_s') AS o "
            "FROM event_index AS i JOIN events AS e ON e.run_id = i.run_id AND e.seq = i.seq "
            "WHERE i.run_id = :run AND i.kind = 'viewpoint_captured') "
            "SELECT step, count(*) AS n, min(seq) AS first, max(seq) AS last, min(o) AS low, max(o) AS high, "
            "max(at) - min(at) AS over FROM c GROUP BY step ORDER BY 3"
        ),
        {"run": plain(run_id)},
    ).all()
    ends = [row.first for row in rows] + [row.last for row in rows]
    offsets = {
        event.seq: float(event.payload.get("clock_offset_s") or 0.0) for event in read_rows(connection, run_id, ends)
    }
    return [
        ClockSeries(
            row.step or "",
            row.n,
            offsets[row.first],
            offsets[row.last],
            float(row.low or 0.0),
            float(row.high or 0.0),
            float(row.over or 0.0),
        )
        for row in rows
    ]


def events_of(connection: Connection, run_id: str, *kinds: str, newest: bool = False) -> list[EventRow]:
    """All events of some kinds, up to LISTED of them, with their payloads."""
    seqs = seqs_of_kind(connection, run_id, kinds, limit=LISTED, newest=newest)
    return read_rows(connection, run_id, seqs, whole=True)


@dataclass(frozen=True, slots=True)
class Session:
    """One start of the runner's process."""

    row: EventRow
    software: Mapping[str, str]
    changed: Mapping[str, tuple[str, str]]  # against the session before it: distribution → before, now


def sessions(rows: Sequence[EventRow]) -> list[Session]:
    """The starts of a runner, each compared with the one before."""
    found: list[Session] = []
    before: dict[str, str] | None = None
    for row in rows:
        software = {str(name): str(version) for name, version in dict(row.payload.get("software") or {}).items()}
        names = sorted({*software, *before}) if before is not None else []
        earlier = before or {}
        changed = {
            name: (earlier.get(name, ""), software.get(name, ""))
            for name in names
            if earlier.get(name) != software.get(name)
        }
        found.append(Session(row, software, changed))
        before = software
    return found
