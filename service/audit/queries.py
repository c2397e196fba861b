"""Reads, filters and searches the runs, events and files of a data folder in SQL; none of it reads a whole run."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar, cast

from pydantic import ValidationError
from pydantic_core import from_json
from sqlalchemy import Connection, bindparam, text

from service.audit.filters import ArtefactFilter, EventFilter
from service.core.errors import IntegrityError
from service.core.records.base import Record
from service.core.records.entered import RunAbout
from service.core.records.run_events import RunStarted
from service.store.artefacts import to_artefact
from service.store.database.database import is_postgres
from service.store.event_index import cut_words, matching
from service.store.events import event_sha256, parse_canonical
from service.store.records import SITE, Artefact, UnknownRunError
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


# --- filters, searches and pages of the events and files of a run -------------------------------------------------

COUNT_LIMIT = 10_000  # matches of a filter beyond this number are not counted
_SEARCH_CHARACTERS = 200
_SEARCH_TERMS = 8


@dataclass(frozen=True, slots=True)
class EventPage:
    """A page of events in order, and where the neighbouring pages begin."""

    rows: Sequence[EventRow]
    before: int | None  # parameter for the page before; None: there is none
    after: int | None
    count: int | None  # number of matches; None: more than COUNT_LIMIT
    missing: int = 0  # events missing from the index, which filters cannot find


def search_terms(q: str) -> list[list[str]]:
    """Return a person's words, each cut as those of the index are; some become several words in a row."""
    return [cut for word in plain(q)[:_SEARCH_CHARACTERS].split() if (cut := cut_words(word))][:_SEARCH_TERMS]


def events_page(
    connection: Connection,
    run_id: str,
    wanted: EventFilter,
    *,
    after: int = 0,
    before: int = 0,
    size: int = PAGE,
    counted: int | None = None,
) -> EventPage:
    """Return the first events after `after`, or with `before` the last ones before it. Raises UnknownRunError.

    Args:
        counted: the number of matches, if known; otherwise they are counted.
    """
    last, _ = head(connection, run_id)
    after, before = (min(max(value, 0), LARGEST_SEQ) for value in (after, before))
    backwards = before > 0
    if not wanted.active:
        low = max(1, min(before, last + 1) - size) if backwards else after + 1
        seqs = list(range(low, min(low + size, last + 1, before if backwards else last + 1)))
        earlier, later = low > 1, bool(seqs) and seqs[-1] < last
        count: int | None = last
    else:
        seqs, more = _matching(connection, run_id, wanted, before if backwards else after, backwards, size)
        ends = (seqs[0], seqs[-1]) if seqs else (last + 1, 0)
        earlier = more if backwards else after > 0 and _any(connection, run_id, wanted, ends[0], backwards=True)
        later = more if not backwards else _any(connection, run_id, wanted, ends[1], backwards=False)
        count = _count(connection, run_id, wanted) if counted is None else counted
    rows = read_rows(connection, run_id, seqs)
    return EventPage(
        rows=rows,
        before=(seqs[0] if seqs else last + 1) if earlier else None,
        after=seqs[-1] if later and seqs else None,
        count=count,
        missing=_not_indexed(connection, run_id, last) if wanted.active else 0,
    )


def _where(connection: Connection, run_id: str, wanted: EventFilter) -> tuple[str, dict[str, Any]]:
    """Return conditions on event_index AS i.

    Reading a range of positions in order is cheaper than using another index.
    """
    ends = connection.execute(
        text(
            "SELECT (SELECT position FROM event_index WHERE run_id = :run ORDER BY seq LIMIT 1), "
            "(SELECT position FROM event_index WHERE run_id = :run ORDER BY seq DESC LIMIT 1)"
        ),
        {"run": plain(run_id)},
    ).one()
    plus = "" if is_postgres(connection) else "+"  # keeps SQLite from using an index on these columns
    conditions = ["i.position BETWEEN :low AND :high", f"{plus}i.run_id = :run"]
    values: dict[str, Any] = {"run": plain(run_id), "low": ends[0] or 0, "high": ends[1] or -1}
    for column, value in (("kind", wanted.kind), ("step", wanted.step), ("actor", wanted.person)):
        if value:
            conditions.append(f"{plus}i.{column} = :{column}")
            values[column] = plain(value)
    if wanted.device:
        conditions.append(
            "(i.device = :device OR i.seq IN (SELECT seq FROM artefacts WHERE run_id = :run AND device = :device))"
        )
        values["device"] = plain(wanted.device)
    if wanted.q:
        terms = search_terms(wanted.q)
        if not terms:
            conditions.append("1 = 0")
        else:
            positions, values["match"] = matching(connection, terms, beginnings=True)
            in_range = f"SELECT position FROM ({positions}) AS found WHERE position BETWEEN :low AND :high"
            conditions.append(f"i.position IN ({in_range})")
    return " AND ".join(conditions), values


def _matching(
    connection: Connection, run_id: str, wanted: EventFilter, seq: int, backwards: bool, size: int
) -> tuple[list[int], bool]:
    where, values = _where(connection, run_id, wanted)
    beyond, order = ("<", "DESC") if backwards else (">", "ASC")
    found = list(
        connection.execute(
            text(
                f"SELECT i.seq FROM event_index AS i WHERE {where} AND i.seq + 0 {beyond} :seq "
                f"ORDER BY i.position {order} LIMIT :limit"
            ),
            values | {"seq": seq, "limit": size + 1},
        ).scalars()
    )
    return sorted(found[:size]), len(found) > size


def _any(connection: Connection, run_id: str, wanted: EventFilter, seq: int, *, backwards: bool) -> bool:
    return bool(_matching(connection, run_id, wanted, seq, backwards, 1)[0])


def _count(connection: Connection, run_id: str, wanted: EventFilter) -> int | None:
    where, values = _where(connection, run_id, wanted)
    statement = f"SELECT count(*) FROM (SELECT 1 FROM event_index AS i WHERE {where} LIMIT :limit) AS found"
    count = connection.execute(text(statement), values | {"limit": COUNT_LIMIT + 1}).scalar_one()
    return count if count <= COUNT_LIMIT else None


def _not_indexed(connection: Connection, run_id: str, last: int) -> int:
    indexed = connection.execute(
        text("SELECT count(*) FROM event_index WHERE run_id = :run"), {"run": plain(run_id)}
    ).scalar_one()
    return last - indexed


@dataclass(slots=True)
class Facets:
    """The values to filter by, each with its number of events."""

    kinds: dict[str, int] = field(default_factory=dict[str, int])
    steps: dict[str, int] = field(default_factory=dict[str, int])
    people: dict[str, int] = field(default_factory=dict[str, int])
    devices: dict[str, int] = field(default_factory=dict[str, int])

    def matching(self, wanted: EventFilter) -> int | None:
        """Return the number of events that match a filter with one condition; None with none or several."""
        counts = {"kind": self.kinds, "step": self.steps, "person": self.people}
        fields = wanted.query()
        if len(fields) != 1 or not counts.keys() & fields.keys():
            return None
        ((name, value),) = fields.items()
        return counts[name].get(value, 0)

    def copy(self) -> Facets:
        """Return a copy that can be continued while pages read this one."""
        return Facets(dict(self.kinds), dict(self.steps), dict(self.people), dict(self.devices))

    def add(self, connection: Connection, run_id: str, after: int, upto: int) -> None:
        """Count the events of a range."""
        rows = connection.execute(
            text(
                "SELECT kind, step, device, actor, count(*) AS n FROM event_index "
                "WHERE run_id = :run AND seq > :after AND seq <= :upto GROUP BY 1, 2, 3, 4"
            ),
            {"run": plain(run_id), "after": after, "upto": upto},
        )
        for row in rows:
            for counts, name in (
                (self.kinds, row.kind),
                (self.steps, row.step),
                (self.devices, row.device),
                (self.people, row.actor),
            ):
                if name is not None:
                    counts[name] = counts.get(name, 0) + row.n


_LARGEST_PAGE = 10**6


@dataclass(frozen=True, slots=True)
class ArtefactPage:
    """A page of artefacts, and the number of pages and matches."""

    rows: Sequence[Artefact]
    page: int
    pages: int
    count: int
    size_bytes: int  # number of matches


_COLUMNS = (
    "run_id, seq, position, sha256, kind, media_type, size_bytes, original_name, device, step, attempt, viewpoint, "
    "who, at_utc, monotonic_s, record_sha256"
)


def artefacts_page(
    connection: Connection, run_id: str, wanted: ArtefactFilter, *, page: int = 1, size: int = PAGE
) -> ArtefactPage:
    """Return one page, in the order of the events; a page number out of range gives the nearest.

    Raises UnknownRunError.
    """
    head(connection, run_id)
    where, values = _artefact_condition(connection, run_id, wanted)
    totals = connection.execute(
        text(f"SELECT count(*) AS n, coalesce(sum(size_bytes), 0) AS size FROM artefacts WHERE {where}"), values
    ).one()
    pages = max(1, math.ceil(totals.n / size))
    page = min(max(page, 1), pages, _LARGEST_PAGE)
    rows = connection.execute(
        text(
            f"SELECT {_COLUMNS} FROM artefacts WHERE {where} ORDER BY run_id, seq, position "
            "LIMIT :limit OFFSET :offset"
        ),
        values | {"limit": size, "offset": (page - 1) * size},
    )
    return ArtefactPage([to_artefact(row) for row in rows], page, pages, totals.n, int(totals.size))


def _artefact_condition(connection: Connection, run_id: str, wanted: ArtefactFilter) -> tuple[str, dict[str, Any]]:
    contains = "ILIKE" if is_postgres(connection) else "LIKE"  # either takes A for a, and no other letters for equal
    conditions, values = ["run_id = :run"], {"run": plain(run_id)}
    for column in ("kind", "step", "device", "viewpoint"):
        value = getattr(wanted, column)
        if value:
            conditions.append(f"{column} = :{column}")
            values[column] = plain(value)
    for index, word in enumerate(plain(wanted.q)[:200].replace("\0", " ").split()[:8]):
        escaped = word.replace("\\", r"\\").replace("%", r"\%").replace("_", r"\_")
        columns = ("original_name", "viewpoint", "sha256", "kind", "step", "who")
        conditions.append("(" + " OR ".join(f"{c} {contains} :word{index} ESCAPE '\\'" for c in columns) + ")")
        values[f"word{index}"] = f"%{escaped}%"
    return " AND ".join(conditions), values


def artefacts_of_events(connection: Connection, run_id: str, seqs: Sequence[int]) -> list[Artefact]:
    """Return the artefacts that these events brought."""
    if not seqs:
        return []
    rows = connection.execute(
        text(
            f"SELECT {_COLUMNS} FROM artefacts WHERE run_id = :run AND seq IN :seqs ORDER BY seq, position LIMIT 1000"
        ).bindparams(bindparam("seqs", expanding=True)),
        {"run": plain(run_id), "seqs": list(seqs)},
    )
    return [to_artefact(row) for row in rows]


def one_artefact(connection: Connection, run_id: str, sha256: str) -> list[Artefact]:
    """Return every record of a file in this run; the first says where it came from. Raises UnknownRunError."""
    head(connection, run_id)
    rows = connection.execute(
        text(
            f"SELECT {_COLUMNS} FROM artefacts WHERE sha256 = :sha256 AND run_id = :run "
            "ORDER BY seq, position LIMIT 100"
        ),
        {"run": plain(run_id), "sha256": plain(sha256)},
    )
    found = [to_artefact(row) for row in rows]
    if not found:
        raise UnknownRunError(
            "the run has no artefact of this SHA-256",
            where=plain(sha256)[:80],
            remedy="Search for it among the artefacts",
        )
    return found


def artefact_facets(connection: Connection, run_id: str) -> dict[str, dict[str, int]]:
    """Return the values to filter by, each with its number of artefacts."""
    rows = connection.execute(
        text("SELECT kind, step, device, count(*) AS n FROM artefacts WHERE run_id = :run GROUP BY 1, 2, 3"),
        {"run": plain(run_id)},
    )
    counts: dict[str, dict[str, int]] = {"kind": {}, "step": {}, "device": {}}
    for row in rows:
        for name, value in (("kind", row.kind), ("step", row.step), ("device", row.device)):
            if value:
                counts[name][value] = counts[name].get(value, 0) + row.n
    return counts
