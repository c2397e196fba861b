"""The index by which auditors filter and search events, written with each event and derived from it alone.

It has a narrow row for each event, the facets that pages ask for in SQL, and a full-text index of plain words. All of
it is computed here in Python, so that every database finds the same events, and a verification computes it again.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from pydantic_core import from_json
from sqlalchemy import Connection, and_, bindparam, func, insert, literal_column, select, text

from service.store.database.database import is_postgres
from service.store.database.tables import event_facets, event_index, events

# Facet → where its value stands in the payload. A facet of an event is a text, a number or a truth value.
FACETS: Mapping[str, tuple[str, ...]] = {
    "account": ("account",),
    "action": ("action",),
    "address": ("address",),
    "body_serial": ("camera", "body_serial"),
    "boot": ("boot",),
    "clock_offset_s": ("clock_offset_s",),
    "field": ("field",),
    "job": ("job",),
    "job_kind": ("job_kind",),
    "moved_run": ("moved_run",),
    "outcome": ("outcome",),
    "protocol_id": ("protocol_id",),
    "protocol_sha256": ("protocol_sha256",),
    "protocol_version": ("protocol_version",),
}
WORDS_TABLE = "CREATE VIRTUAL TABLE event_words USING fts5(words, content='', columnsize=0, tokenize='ascii')"
_LONGEST = 200  # characters of a word or a facet; what is longer is cut
_WORD = re.compile(r"[^\W_]+")
_AT_ONCE = 500  # events
_LAST_PLACE = 16383  # of a word in a tsvector
_EXACT = 2**53  # a larger integer in canonical JSON was a float

# Statements of every append are put together once, which takes SQLAlchemy longer than SQLite takes to execute them.
_NEXT_POSITION = select(func.coalesce(func.max(event_index.c.position), 0) + 1)
_INSERT_ROWS = insert(event_index)
_INSERT_FACETS = insert(event_facets)
_INSERT_VECTORS = text("INSERT INTO event_words (position, words) VALUES (:position, CAST(:words AS tsvector))")
_INSERT_WORDS = text("INSERT INTO event_words (rowid, words) VALUES (:position, :words)")
OF_FACET = and_(event_facets.c.run_id == event_index.c.run_id, event_facets.c.seq == event_index.c.seq)
_INDEXED = (
    select(
        event_index.c.position,
        event_index.c.run_id,
        event_index.c.seq,
        event_index.c.step,
        event_index.c.device,
        events.c.actor,
        events.c.payload,
    )
    .join(events, and_(events.c.run_id == event_index.c.run_id, events.c.seq == event_index.c.seq))
    .where(event_index.c.position > bindparam("after"))
    .order_by(event_index.c.position)
    .limit(_AT_ONCE)
)
_FACETS = (
    select(event_index.c.position, event_facets.c.name, event_facets.c.value)
    .join(event_facets, OF_FACET)
    .where(event_index.c.position > bindparam("after"), event_index.c.position <= bindparam("last"))
    .order_by(event_index.c.position, event_facets.c.name)
)
_ROWID = literal_column("events.rowid")  # no event is ever removed, so it counts them
_INSERTED = (
    select(_ROWID, events.c.run_id, events.c.seq, events.c.kind, events.c.actor, events.c.payload)
    .where(bindparam("after") < _ROWID)
    .order_by(_ROWID)
    .limit(_AT_ONCE)
)


class EventToIndex(NamedTuple):
    """An event that was just inserted."""

    run_id: str
    seq: int
    kind: str
    actor: str
    payload: Any  # plain data; None if it is not JSON


def index_events(connection: Connection, new: Sequence[EventToIndex]) -> None:
    """Write the index of events that were just inserted, in the same transaction, after all that are in it."""
    first = connection.execute(_NEXT_POSITION).scalar_one()
    rows: list[dict[str, Any]] = []
    for position, event in enumerate(new, first):
        row = {"position": position, "run_id": event.run_id, "seq": event.seq, "kind": event.kind}
        rows.append(row | {"actor": event.actor, **columns_of(event.payload)})
    connection.execute(_INSERT_ROWS, rows)
    _write_derived(connection, [(position, event) for position, event in enumerate(new, first)])


def index_all(connection: Connection) -> None:
    """Write the index of every event of a database that has none, in the order in which the events were inserted."""
    after = 0
    while rows := connection.execute(_INSERTED, {"after": after}).all():
        events_of_chunk = [
            EventToIndex(run, seq, kind, actor, plain_payload(text)) for _, run, seq, kind, actor, text in rows
        ]
        index_events(connection, events_of_chunk)
        after = rows[-1][0]


def index_again(connection: Connection) -> None:
    """Write facets and words of all events that have a row in the index, for tables that are new."""
    for event in indexed_events(connection):
        _write_derived(
            connection, [(event.position, EventToIndex(event.run_id, event.seq, "", event.actor, event.payload))]
        )


def _write_derived(connection: Connection, placed: Sequence[tuple[int, EventToIndex]]) -> None:
    facets = [
        {"run_id": event.run_id, "seq": event.seq, "name": name, "value": value}
        for _, event in placed
        for name, value in facets_of(event.payload)
    ]
    if facets:
        connection.execute(_INSERT_FACETS, facets)
    words = [{"position": place, "words": words_of(event.actor, event.payload)} for place, event in placed]
    if is_postgres(connection):
        vectors = [row | {"words": vector(str(row["words"]))} for row in words]
        connection.execute(_INSERT_VECTORS, vectors)
    else:
        connection.execute(_INSERT_WORDS, words)


@dataclass(frozen=True, slots=True)
class IndexedEvent:
    """An event with what the index says of it."""

    position: int
    run_id: str
    seq: int
    step: str | None  # this and the next two as the index has them
    device: str | None
    facets: Sequence[tuple[str, str]]
    actor: str
    payload: Any  # plain data; None if it is not JSON, which the verification of the chain reports

    @property
    def agrees(self) -> bool:
        """True if step, device and facets are those of the payload."""
        named = {"step": self.step, "device": self.device}
        return self.payload is None or (named == columns_of(self.payload) and self.facets == facets_of(self.payload))


def indexed_events(connection: Connection) -> Iterator[IndexedEvent]:
    """Yield all events that have a row in the index, in the order of writing."""
    after = -1
    while rows := connection.execute(_INDEXED, {"after": after}).all():
        facets: dict[int, list[tuple[str, str]]] = {}
        for position, name, value in connection.execute(_FACETS, {"after": after, "last": rows[-1].position}):
            facets.setdefault(position, []).append((name, value))
        for position, run_id, seq, step, device, actor, payload in rows:
            said = facets.get(position, [])
            yield IndexedEvent(position, run_id, seq, step, device, said, actor, plain_payload(payload))
        after = rows[-1].position


def plain_payload(payload: str) -> Any:
    """Return the plain data of a payload; None if it is not JSON."""
    try:
        return from_json(payload)
    except ValueError:
        return None


def columns_of(payload: Any) -> dict[str, str | None]:
    """Return step and device of a payload; None for what it does not name."""
    named: dict[str, Any] = payload if isinstance(payload, dict) else {}
    found = {name: named.get(name) for name in ("step", "device")}
    return {name: value if isinstance(value, str) else None for name, value in found.items()}


def facets_of(payload: Any) -> list[tuple[str, str]]:
    """Return name and value of the facets of a payload, sorted by name."""
    found: list[tuple[str, str]] = []
    named: dict[str, Any] = payload if isinstance(payload, dict) else {}
    for name, (first, *others) in FACETS.items():
        value = named.get(first)
        for part in others:
            value = value.get(part) if isinstance(value, dict) else None
        if value is not None and isinstance(value, str | int | float):
            found.append((name, facet_value(value)))
    return found


def facet_value(value: str | float) -> str:
    """Return the text by which a value of a facet is found; a number as in JSON, a truth value as true or false."""
    if isinstance(value, bool):
        return str(value).lower()
    exact = isinstance(value, str) or abs(value) <= _EXACT
    return str(value if exact else float(value))[:_LONGEST]


def words_of(actor: str, payload: Any) -> str:
    """Return the words by which an event is found, separated by spaces: of its actor and of the payload's texts.

    Numbers and names of fields are not searched for.
    """
    texts = [actor]
    _add_texts([payload], texts)
    return " ".join(cut_words(" ".join(texts)))


def _add_texts(items: Iterable[Any], found: list[str]) -> None:
    """Append all texts among the items, and in what they hold, in their order."""
    for item in items:
        if isinstance(item, str):
            found.append(item)
        elif isinstance(item, dict):
            _add_texts(item.values(), found)
        elif isinstance(item, list):
            _add_texts(item, found)


def cut_words(said: str) -> list[str]:
    """Return the words of a text: runs of letters and digits in lower case, without accents."""
    if not said.isascii():
        decomposed = unicodedata.normalize("NFKD", said).casefold()
        said = "".join(letter for letter in decomposed if not unicodedata.combining(letter))
    return [word[:_LONGEST] for word in _WORD.findall(said.lower())]


def vector(words: str) -> str:
    """Return words as a value of PostgreSQL's type tsvector, which keeps the place of each."""
    return " ".join(f"'{word}':{min(place, _LAST_PLACE)}" for place, word in enumerate(words.split(), 1))


def matching(connection: Connection, terms: Sequence[Sequence[str]], *, beginnings: bool = False) -> tuple[str, str]:
    """Return a query of the positions of events that have all terms, and the value of its parameter `match`.

    A term is words in a row; with `beginnings`, the last one also as the beginning of a word.
    """
    if is_postgres(connection):
        end = ":*" if beginnings else ""
        found = " & ".join("(" + " <-> ".join(f"'{word}'" for word in words) + end + ")" for words in terms)
        return "SELECT position FROM event_words WHERE words @@ CAST(:match AS tsquery)", found
    end = "*" if beginnings else ""
    found = " AND ".join(f'"{" ".join(words)}"{end}' for words in terms)
    return "SELECT rowid AS position FROM event_words WHERE event_words MATCH :match", found
