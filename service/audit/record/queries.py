"""Queries of the auditor's pages: runs and events, filtered, searched and paged in SQL. None reads a whole run."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from pydantic import ValidationError
from sqlalchemy import Connection, text

from service.core.errors import IntegrityError
from service.core.records.base import Record
from service.core.records.events import RunStarted
from service.store.errors import UnknownRunError
from service.store.events import event_sha256, parse_canonical
from service.store.records import SITE
from service.store.verification.chain_checks import summary

PAGE = 50  # events or artefacts on one page
COUNT_LIMIT = 10_000  # matches of a filter beyond this number are not counted
_INLINE_CHARACTERS = 6_000  # of a payload in a list; a longer one is shown on the page of its event
_LARGEST_SEQ = 2**53
_SEARCH_CHARACTERS = 200
_SEARCH_TERMS = 8
_WORD = re.compile(r"[^\W_]")


P = TypeVar("P", bound=Record)

# --- runs ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class RunBasics:
    """What never changes in a run, and the present end of its chain."""

    run_id: str
    created_utc: str
    simulated: bool
    protocol: str  # its id; "" if the first event cannot be read
    version: str
    operator: str
    origin: str  # captured, imported
    head_seq: int
    head_sha256: str


def runs(connection: Connection, run_id: str | None = None) -> list[RunBasics]:
    """All runs, newest first; or the run of this name, if there is one."""
    rows = connection.execute(
        text(
            "SELECT r.run_id, r.created_utc, r.simulated, h.seq, h.sha256, "
            "json_extract(e.payload, '$.protocol_id') AS protocol, "
            "json_extract(e.payload, '$.protocol_version') AS version, "
            "json_extract(e.payload, '$.operator') AS operator, "
            "json_extract(e.payload, '$.origin') AS origin "
            "FROM runs AS r LEFT JOIN heads AS h ON h.run_id = r.run_id "
            "LEFT JOIN events AS e ON e.run_id = r.run_id AND e.seq = 1 AND json_valid(e.payload) "
            "WHERE r.run_id <> :site AND (:run IS NULL OR r.run_id = :run) ORDER BY r.created_utc DESC, r.run_id DESC"
        ),
        {"site": SITE, "run": None if run_id is None else plain(run_id)},
    )
    return [
        RunBasics(
            run_id=row.run_id,
            created_utc=row.created_utc,
            simulated=bool(row.simulated),
            protocol=str(row.protocol or ""),
            version=str(row.version or ""),
            operator=str(row.operator or ""),
            origin=str(row.origin or "captured"),
            head_seq=row.seq or 0,
            head_sha256=row.sha256 or "",
        )
        for row in rows
    ]


def head(connection: Connection, run_id: str) -> tuple[int, str]:
    """Number and hash of the last event of a run or of the site. Raises UnknownRunError."""
    row = connection.execute(
        text("SELECT seq, sha256 FROM heads WHERE run_id = :run"), {"run": plain(run_id)}
    ).one_or_none()
    if row is None:
        raise UnknownRunError(f"there is no run {run_id!r}", remedy="Choose one from the list of runs")
    return row.seq, row.sha256


def root(connection: Connection, run_id: str) -> RunStarted:
    """The first event of a run. Raises UnknownRunError, IntegrityError."""
    event = one_event(connection, run_id, 1)
    try:
        return RunStarted.model_validate(event.payload)
    except ValueError as error:
        raise IntegrityError("the run's first event is not run_started", where=run_id) from error


def plain(value: str) -> str:
    """The text without lone surrogates, which a request may hold and SQLite refuses."""
    return value.encode("utf-8", "replace").decode()


# --- events ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class EventFilter:
    """A filter for events; an empty field matches all."""

    step: str = ""
    device: str = ""
    person: str = ""
    kind: str = ""
    q: str = ""

    @property
    def active(self) -> bool:
        """Whether anything is filtered."""
        return any((self.step, self.device, self.person, self.kind, self.q))

    def query(self) -> dict[str, str]:
        """The filter as query parameters of a link."""
        fields = {"step": self.step, "device": self.device, "person": self.person, "kind": self.kind, "q": self.q}
        return {name: value for name, value in fields.items() if value}


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
    job: str = ""  # that it is about

    def record(self, kind: type[P]) -> P | None:
        """The payload as a record of this kind; None if it is another kind, was altered, or is not complete here."""
        try:
            return kind.model_validate(self.payload)
        except ValidationError:
            return None


@dataclass(frozen=True, slots=True)
class EventPage:
    """A page of events in order, and where the neighbouring pages begin."""

    rows: Sequence[EventRow]
    before: int | None  # parameter for the page before; None: there is none
    after: int | None
    count: int | None  # number of matches; None: more than COUNT_LIMIT
    missing: int = 0  # events missing from the index, which filters cannot find


def search_expression(q: str) -> str | None:
    """A person's words as an FTS5 expression that matches every word as a prefix; None if there is no word."""
    words = plain(q)[:_SEARCH_CHARACTERS].replace("\0", " ").replace('"', " ").split()
    terms = [word for word in words if _WORD.search(word)][:_SEARCH_TERMS]
    return " AND ".join(f'"{term}"*' for term in terms) or None


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
    """The first events after `after`, or with `before` the last ones before it. Raises UnknownRunError.

    Args:
        counted: the number of matches, if known; otherwise they are counted.
    """
    last, _ = head(connection, run_id)
    after, before = (min(max(value, 0), _LARGEST_SEQ) for value in (after, before))
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
    """Conditions on event_index AS i. Reading a range of positions in order is cheaper than using another index."""
    ends = connection.execute(
        text(
            "SELECT (SELECT position FROM event_index WHERE run_id = :run ORDER BY seq LIMIT 1), "
            "(SELECT position FROM event_index WHERE run_id = :run ORDER BY seq DESC LIMIT 1)"
        ),
        {"run": plain(run_id)},
    ).one()
    conditions = ["i.position BETWEEN :low AND :high", "+i.run_id = :run"]
    values: dict[str, Any] = {"run": plain(run_id), "low": ends[0] or 0, "high": ends[1] or -1}
    for column, value in (("kind", wanted.kind), ("step", wanted.step), ("actor", wanted.person)):
        if value:
            conditions.append(f"+i.{column} = :{column}")
            values[column] = plain(value)
    if wanted.device:
        conditions.append(
            "(i.device = :device OR i.seq IN (SELECT seq FROM artefacts WHERE run_id = :run AND device = :device))"
        )
        values["device"] = plain(wanted.device)
    if wanted.q:
        match = search_expression(wanted.q)
        if match is None:
            conditions.append("0")
        else:
            conditions.append(
                "i.position IN (SELECT rowid FROM event_words "
                "WHERE event_words MATCH :match AND rowid BETWEEN :low AND :high)"
            )
            values["match"] = match
    return " AND ".join(conditions), values


def _matching(
    connection: Connection, run_id: str, wanted: EventFilter, seq: int, backwards: bool, size: int
) -> tuple[list[int], bool]:
    where, values = _where(connection, run_id, wanted)
    beyond, order = ("<", "DESC") if backwards else (">", "ASC")
    found = list(
        connection.execute(
            text(
                f"SELECT i.seq FROM event_index AS i WHERE {where} AND +i.seq {beyond} :seq "
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
    statement = f"SELECT count(*) FROM (SELECT 1 FROM event_index AS i WHERE {where} LIMIT :limit)"
    count = connection.execute(text(statement), values | {"limit": COUNT_LIMIT + 1}).scalar_one()
    return count if count <= COUNT_LIMIT else None


def _not_indexed(connection: Connection, run_id: str, last: int) -> int:
    indexed = connection.execute(
        text("SELECT count(*) FROM event_index WHERE run_id = :run"), {"run": plain(run_id)}
    ).scalar_one()
    return last - indexed


_ROW = (
    "SELECT e.seq, e.at_utc, e.monotonic_s, e.actor, e.kind, e.previous_sha256, e.sha256, length(e.payload) AS size, "
    "CASE WHEN length(e.payload) <= :inline THEN e.payload WHEN json_valid(e.payload) THEN "
    "(SELECT json_group_object(j.key, json(json_quote(j.value))) FROM json_each(e.payload) AS j "
    "WHERE j.type NOT IN ('object', 'array')) END AS payload, "
    "(SELECT count(*) FROM artefacts AS a WHERE a.run_id = e.run_id AND a.seq = e.seq) AS artefacts "
    "FROM events AS e WHERE e.run_id = :run AND e.seq IN (SELECT value FROM json_each(:seqs)) ORDER BY e.seq"
)


def read_rows(connection: Connection, run_id: str, seqs: Sequence[int], *, whole: bool = False) -> list[EventRow]:
    """These events; unless `whole`, long payloads lack their lists and tables."""
    inline = _LARGEST_SEQ if whole else _INLINE_CHARACTERS
    values = {"run": plain(run_id), "seqs": json.dumps(list(seqs)), "inline": inline}
    return [_event_row(row, whole=row.size <= inline) for row in connection.execute(text(_ROW), values)]


def one_event(connection: Connection, run_id: str, seq: int) -> EventRow:
    """An event with its whole payload. Raises UnknownRunError."""
    last, _ = head(connection, run_id)
    found = read_rows(connection, run_id, [min(max(seq, 0), _LARGEST_SEQ)], whole=True)
    if not found:
        raise UnknownRunError(f"there is no event {seq}", where=run_id, remedy=f"The run has events 1 to {last}")
    return found[0]


def _event_row(row: Any, *, whole: bool) -> EventRow:
    try:
        payload: dict[str, Any] = parse_canonical(row.payload or "null") or {}
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
        size=row.size,
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
# fmt: on


def headline(payload: Mapping[str, Any]) -> str:
    """An event in one line: the most telling fields first, without field names if the value is clear without them."""
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
    """The hash of an event's content as it is now; an altered event has another hash than the recorded one."""
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
    """The event of the run that has this hash, by the link in its successor or as the last one; or None."""
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
    """Numbers of the first events of some kinds, or with `newest` of the last ones, in order."""
    order = "DESC" if newest else "ASC"
    found = connection.execute(
        text(
            "SELECT seq FROM event_index WHERE run_id = :run AND kind IN (SELECT value FROM json_each(:kinds)) "
            f"ORDER BY +seq {order} LIMIT :limit"  # "+": use the index on the kind, which has few rows
        ),
        {"run": plain(run_id), "kinds": json.dumps(list(kinds)), "limit": limit},
    ).scalars()
    return sorted(found)


def count_of_kind(connection: Connection, run_id: str, kind: str) -> int:
    """The number of events of a kind."""
    statement = text("SELECT count(*) FROM event_index WHERE run_id = :run AND kind = :kind")
    return int(connection.execute(statement, {"run": plain(run_id), "kind": kind}).scalar_one())


@dataclass(slots=True)
class Facets:
    """The values to filter by, each with its number of events."""

    kinds: dict[str, int] = field(default_factory=dict[str, int])
    steps: dict[str, int] = field(default_factory=dict[str, int])
    people: dict[str, int] = field(default_factory=dict[str, int])
    devices: dict[str, int] = field(default_factory=dict[str, int])

    def matching(self, wanted: EventFilter) -> int | None:
        """The number of events that match a filter of one property; None for other filters."""
        counts = {"kind": self.kinds, "step": self.steps, "person": self.people}
        fields = wanted.query()
        if len(fields) != 1 or not counts.keys() & fields.keys():
            return None
        ((name, value),) = fields.items()
        return counts[name].get(value, 0)

    def copy(self) -> Facets:
        """A copy that can be continued while pages read this one."""
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
