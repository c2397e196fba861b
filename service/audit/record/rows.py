"""Reads the runs of a data folder and their events in SQL for the auditor's pages, without reading whole runs."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar, cast

from pydantic import ValidationError
from pydantic_core import from_json
from sqlalchemy import Connection, bindparam, text

from service.core.errors import IntegrityError
from service.core.records.base import Record
from service.core.records.entered import RunAbout
from service.core.records.run_events import RunStarted
from service.store.events import event_sha256, parse_canonical
from service.store.records import SITE, UnknownRunError
from service.store.verification.chain_checks import summary

PAGE = 50  # events or artefacts on one page
LARGEST_SEQ = 2**53


@dataclass(frozen=True, slots=True)
class RunBasics:
    """The facts of a run that never change, and the present end of its chain."""

    run_id: str
    created_utc: str
    simulated: bool
    protocol: str  # its id; "" if the first event cannot be read
    version: str
    operator: str
    origin: str  # captured, imported
    about: RunAbout  # what people entered at its start
    head_seq: int
    head_sha256: str


def runs(connection: Connection, run_id: str | None = None) -> list[RunBasics]:
    """Return all runs, newest first; or the run of this name, if there is one."""
    rows = connection.execute(
        text(
            "SELECT r.run_id, r.created_utc, r.simulated, h.seq, h.sha256, e.payload "
            "FROM runs AS r LEFT JOIN heads AS h ON h.run_id = r.run_id "
            "LEFT JOIN events AS e ON e.run_id = r.run_id AND e.seq = 1 "
            "WHERE r.run_id <> :site AND (CAST(:run AS TEXT) IS NULL OR r.run_id = :run) "
            "ORDER BY r.created_utc DESC, r.run_id DESC"
        ),
        {"site": SITE, "run": None if run_id is None else plain(run_id)},
    )
    return [_basics(row) for row in rows]


def _basics(row: Any) -> RunBasics:
    started = plain_payload(row.payload)
    return RunBasics(
        run_id=row.run_id,
        created_utc=row.created_utc,
        simulated=bool(row.simulated),
        protocol=str(started.get("protocol_id") or ""),
        version=str(started.get("protocol_version") or ""),
        operator=str(started.get("operator") or ""),
        origin=str(started.get("origin") or "captured"),
        about=_about(started.get("about")),
        head_seq=row.seq or 0,
        head_sha256=row.sha256 or "",
    )


def plain_payload(content: str | None) -> dict[str, Any]:
    """Return the plain data of a payload; empty if it is missing or altered, which the verification reports."""
    try:
        fields: object = from_json(content or "{}")
    except ValueError:
        return {}
    return cast("dict[str, Any]", fields) if isinstance(fields, dict) else {}


def _about(content: object) -> RunAbout:
    try:
        return RunAbout.model_validate(content or {})
    except ValidationError:  # the verification reports it
        return RunAbout()


def head(connection: Connection, run_id: str) -> tuple[int, str]:
    """Return the number and hash of the last event of a run or of the site. Raises UnknownRunError."""
    row = connection.execute(
        text("SELECT seq, sha256 FROM heads WHERE run_id = :run"), {"run": plain(run_id)}
    ).one_or_none()
    if row is None:
        raise UnknownRunError(f"there is no run {run_id!r}", remedy="Choose one from the list of runs")
    return row.seq, row.sha256


def plain(value: str) -> str:
    """Return the text without what a request may hold and a database refuses: lone surrogates and NUL."""
    return value.encode("utf-8", "replace").decode().replace("\0", "\ufffd")


P = TypeVar("P", bound=Record)

_INLINE_CHARACTERS = 6_000  # of a payload in a list; a longer one is shown on the page of its event


def root(connection: Connection, run_id: str) -> RunStarted:
    """Return the first event of a run. Raises UnknownRunError, IntegrityError."""
    event = one_event(connection, run_id, 1)
    try:
        return RunStarted.model_validate(event.payload)
    except ValueError as error:
        raise IntegrityError("the run's first event is not run_started", where=run_id) from error


@dataclass(frozen=True, slots=True)
class EventRow:
    """An event as a page shows it."""

    seq: int
    at_utc: str
    monotonic_s: float
    actor: str
    kind: str
    step: str
    attempt: int | None
    summary: str
    size: int  # characters of the payload
    shown: str  # the payload, indented; "" if it is too long for a list
    payload: Mapping[str, Any]  # complete, or only the short fields of a long payload
    previous_sha256: str
    sha256: str
    artefacts: int
    job: str = ""  # the job that it is about

    def record(self, kind: type[P]) -> P | None:
        """Return the payload as a record of this kind; None if it is of another kind, altered or incomplete."""
        try:
            return kind.model_validate(self.payload)
        except ValidationError:
            return None


_ROW = text(
    "SELECT e.seq, e.at_utc, e.monotonic_s, e.actor, e.kind, e.payload, e.previous_sha256, e.sha256, "
    "(SELECT count(*) FROM artefacts AS a WHERE a.run_id = e.run_id AND a.seq = e.seq) AS artefacts "
    "FROM events AS e WHERE e.run_id = :run AND e.seq IN :seqs ORDER BY e.seq"
).bindparams(bindparam("seqs", expanding=True))
_AT_ONCE = 1000  # events


def read_rows(connection: Connection, run_id: str, seqs: Sequence[int], *, whole: bool = False) -> list[EventRow]:
    """Return these events in order; unless `whole`, long payloads lack their lists and tables."""
    wanted, inline = sorted(set(seqs)), LARGEST_SEQ if whole else _INLINE_CHARACTERS
    return [
        _event_row(row, whole=len(row.payload) <= inline)
        for start in range(0, len(wanted), _AT_ONCE)
        for row in connection.execute(_ROW, {"run": plain(run_id), "seqs": wanted[start : start + _AT_ONCE]})
    ]


def one_event(connection: Connection, run_id: str, seq: int) -> EventRow:
    """Return an event with its whole payload. Raises UnknownRunError."""
    last, _ = head(connection, run_id)
    found = read_rows(connection, run_id, [min(max(seq, 0), LARGEST_SEQ)], whole=True)
    if not found:
        raise UnknownRunError(f"there is no event {seq}", where=run_id, remedy=f"The run has events 1 to {last}")
    return found[0]


def _event_row(row: Any, *, whole: bool) -> EventRow:
    try:
        payload: dict[str, Any] = parse_canonical(row.payload) or {}
        if not whole:
            payload = {name: value for name, value in payload.items() if not isinstance(value, list | dict)}
        shown = json.dumps(payload, indent=1, ensure_ascii=False, sort_keys=True) if whole else ""
        line = headline(payload)
    except (ValueError, AttributeError):  # altered: shown unchanged
        payload, shown, line = {}, str(row.payload)[:_INLINE_CHARACTERS], "this payload cannot be read"
    step, attempt, job = payload.get("step"), payload.get("attempt"), payload.get("job")
    return EventRow(
        seq=row.seq,
        at_utc=row.at_utc,
        monotonic_s=row.monotonic_s,
        actor=row.actor,
        kind=row.kind,
        step=step if isinstance(step, str) else "",
        attempt=attempt if isinstance(attempt, int) else None,
        summary=line,
        size=len(row.payload),
        shown=shown,
        payload=payload,
        previous_sha256=row.previous_sha256,
        sha256=row.sha256,
        artefacts=row.artefacts,
        job=job if isinstance(job, str) else "",
    )


# fmt: off
_TELLING = (
    "viewpoint", "station", "action", "item", "device", "job_kind", "what", "account", "outcome", "field", "measure",
    "error", "message", "note", "text", "why", "reason", "meaning",
)


def headline(payload: Mapping[str, Any]) -> str:
    """Return an event in one line: the most telling fields first, without field names where the value is clear."""
    told = [str(payload[name]) for name in _TELLING if isinstance(payload.get(name), str) and payload[name]]
    if "passed" in payload:
        told.append("passed" if payload["passed"] else _not_passed(payload.get("verdicts")))
    told = [text if len(text) <= 80 else text[:79] + "…" for text in told]
    rest = {name: value for name, value in payload.items() if name not in ("step", "attempt")}
    return " · ".join(told) or summary(rest)


def _not_passed(verdicts: Any) -> str:
    short = [v for v in verdicts or () if isinstance(v, Mapping) and not v.get("passed")]
    return "not decided" if short and all(v.get("undecided") for v in short) else "not passed"


def computed_sha256(run_id: str, row: EventRow) -> str:
    """Hash an event's present content. It differs from the recorded hash if the event was altered."""
    fields = {
        "seq": row.seq,
        "run_id": run_id,
        "at_utc": row.at_utc,
        "monotonic_s": row.monotonic_s,
        "actor": row.actor,
        "payload": row.payload,
        "previous_sha256": row.previous_sha256,
    }
    return event_sha256(fields)


def seq_of_hash(connection: Connection, run_id: str, sha256: str) -> int | None:
    """Return the event of the run that has this hash, by the link in its successor or as the last one; or None."""
    last, end = head(connection, run_id)
    if sha256 == end:
        return last
    found: int | None = connection.execute(
        text("SELECT seq - 1 FROM events WHERE run_id = :run AND previous_sha256 = :sha256 AND seq > 1"),
        {"run": plain(run_id), "sha256": plain(sha256)},
    ).scalar_one_or_none()
    return found


def seqs_of_kind(
    connection: Connection, run_id: str, kinds: Sequence[str], *, limit: int = 1000, newest: bool = False
) -> list[int]:
    """Return numbers of the first events of some kinds, or with `newest` of the last ones, in order."""
    order = "DESC" if newest else "ASC"
    found = connection.execute(
        text(
            "SELECT seq FROM event_index WHERE run_id = :run AND kind IN :kinds "
            f"ORDER BY seq + 0 {order} LIMIT :limit"  # "+ 0": use the index on the kind, which has few rows
        ).bindparams(bindparam("kinds", expanding=True)),
        {"run": plain(run_id), "kinds": list(kinds), "limit": limit},
    ).scalars()
    return sorted(found)


def count_of_kind(connection: Connection, run_id: str, kind: str) -> int:
    """Return the number of events of a kind."""
    statement = text("SELECT count(*) FROM event_index WHERE run_id = :run AND kind = :kind")
    return int(connection.execute(statement, {"run": plain(run_id), "kind": kind}).scalar_one())
