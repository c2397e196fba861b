"""The chain of events: canonical form, hashes, appending, reading back; and which runs go on in another record."""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, cast

import rfc8785
from pydantic_core import PydanticSerializationError, ValidationError
from sqlalchemy import Connection, Row, and_, bindparam, insert, select, update
from sqlalchemy.exc import NoResultFound

from service.core.errors import IntegrityError, StoreError
from service.core.records.base import ArtefactRef
from service.core.records.events import PAYLOAD, Event, Payload, RunMoved
from service.core.words import storable, storable_data
from service.store.database.database import notify
from service.store.database.tables import event_facets, event_index, events, heads
from service.store.durable_effects import Clock, utc_text
from service.store.event_index import OF_FACET, EventToIndex, index_events
from service.store.records import SITE

_OF_MOVES = and_(event_facets.c.name == "moved_run", event_facets.c.run_id == SITE)
# Whether the site's chain says where a run goes on, or that it came here. Each append asks it together with its head.
NAMED = select(event_facets.c.seq).where(_OF_MOVES, event_facets.c.value == bindparam("run")).exists()
# The last event of the site's chain that names a run decides.
_LAST_MOVE = (
    select(event_index.c.seq, event_index.c.kind)
    .join(event_facets, OF_FACET)
    .where(_OF_MOVES, event_facets.c.value == bindparam("run"))
    .order_by(event_index.c.seq.desc())
    .limit(1)
)
_EVERY = (
    select(event_facets.c.value, event_index.c.kind)
    .join(event_index, OF_FACET)
    .where(_OF_MOVES)
    .order_by(event_index.c.seq)
)
_PAYLOAD = select(events.c.payload).where(events.c.run_id == SITE, events.c.seq == bindparam("seq"))


def moved_to(connection: Connection, run_id: str) -> RunMoved | None:
    """Return where a run goes on, if that is in another record. Raises IntegrityError if its event was altered."""
    last = connection.execute(_LAST_MOVE, {"run": run_id}).first()
    if last is None or last.kind != "run_moved":
        return None
    try:
        return RunMoved.model_validate_json(connection.execute(_PAYLOAD, {"seq": last.seq}).scalar_one())
    except (ValidationError, NoResultFound) as error:
        raise IntegrityError(
            "the event that says where this run went cannot be read",
            where=f"{SITE}, event {last.seq}",
            remedy="Run `orthocapture audit verify all`; nothing is appended to this run",
        ) from error


def moved_runs(connection: Connection) -> frozenset[str]:
    """Return the runs that go on in other records."""
    last = {str(run): str(kind) for run, kind in connection.execute(_EVERY)}
    return frozenset(run for run, kind in last.items() if kind == "run_moved")


def require_here(connection: Connection, run_id: str) -> None:
    """Raise StoreError if a run goes on in another record."""
    moved = None if run_id == SITE else moved_to(connection, run_id)
    if moved is not None:
        raise StoreError(
            f"this run was moved and goes on in {moved.database}: nothing is recorded of it here",
            where=f"run {run_id}, event {moved.seq}",
            remedy=f"Go on there (--data {moved.target}), or move it back: orthocapture store copy FROM TO --run RUN",
        )


ROOT = "0" * 64  # previous_sha256 of the first event
_SAFE = 2**53 - 1
# Where json.dumps and RFC 8785 may differ: they write 1.0, 1e-05 and 1e+16 differently, and sort names with surrogate
# pairs differently. Anything that matches takes the slow path, even if it is only text.
_MAY_DIFFER = re.compile("\\.0(?![0-9])|[0-9]e[+-]|[\ud800-\U0010ffff]")
_PLAIN = json.JSONEncoder(ensure_ascii=False, allow_nan=False, sort_keys=True, separators=(",", ":"))
_REF_FIELDS: set[str] = set(ArtefactRef.model_fields)

# Statements of every append are put together once, which takes SQLAlchemy longer than SQLite takes to execute them.
_INSERT = insert(events)
_MOVE_HEAD = update(heads).where(heads.c.run_id == bindparam("run"))
_HEAD = select(heads.c.seq, heads.c.sha256).where(heads.c.run_id == bindparam("run"))
_HEAD_AND_MOVES = _HEAD.add_columns(NAMED.label("named_in_moves"))  # in one query: each append asks it
_LAST = (
    select(events.c.seq, events.c.sha256)
    .where(events.c.run_id == bindparam("run"))
    .order_by(events.c.seq.desc())
    .limit(1)
)
_AFTER = (
    select(events)
    .where(events.c.run_id == bindparam("run"), events.c.seq > bindparam("after_seq"))
    .order_by(events.c.seq)
)


def canonical(value: object) -> str:
    """Return RFC 8785 canonical JSON.

    Raises StoreError for NaN, infinity, integers beyond 2^53 and lone surrogates.
    """
    try:
        return rfc8785.dumps(cast("dict[str, Any]", value)).decode()
    except (rfc8785.CanonicalizationError, UnicodeEncodeError, RecursionError) as error:
        raise StoreError(
            f"this cannot be written as canonical JSON: {error}",
            remedy="Record finite numbers, integers within 2^53 and valid text; bulk data belongs in an artefact",
        ) from error


def canonical_parsed(value: object) -> str:
    """Return RFC 8785 canonical JSON, several times faster, for plain types as `parse_canonical` returns them.

    Raises StoreError for NaN, infinity, integers beyond 2^53 and lone surrogates.
    """
    try:
        text = _PLAIN.encode(value)
    except (ValueError, RecursionError):
        return canonical(value)
    # Nearly every text has none of these, and testing for that is faster than the regular expression.
    if text.isascii() and ".0" not in text and "e-" not in text and "e+" not in text:
        return text
    return canonical(value) if _MAY_DIFFER.search(text) else text


def parse_canonical(text: str) -> Any:
    """Parse canonical JSON so that canonical(parse_canonical(t)) == t. Raises ValueError."""
    try:
        return _READER.decode(text)
    except RecursionError as error:
        raise ValueError("it is nested too deep") from error


def _integer(digits: str) -> int | float:
    # The canonical form of 1e20 has no exponent; beyond the safe range the number can only have been a float.
    value = int(digits)
    return value if -_SAFE <= value <= _SAFE else float(digits)


_READER = json.JSONDecoder(parse_int=_integer)


def sha256_text(text: str) -> str:
    """Return the SHA-256 of the UTF-8 bytes, as 64 hexadecimal digits."""
    return hashlib.sha256(text.encode()).hexdigest()


def event_sha256(fields: Mapping[str, Any]) -> str:
    """Return the SHA-256 of an event from its fields as plain data; the field `sha256` is ignored."""
    return sha256_text(canonical({name: value for name, value in fields.items() if name != "sha256"}))


def event_sha256_of_text(fields: Mapping[str, Any], payload: str) -> str:
    """Return the SHA-256 of an event from its other fields and its payload, which is already canonical JSON."""
    return sha256_text(event_text({name: value for name, value in fields.items() if name != "sha256"}, payload))


def event_text(fields: Mapping[str, Any], payload: str) -> str:
    """Return canonical JSON of an event from its other fields and its payload's canonical JSON."""
    # In canonical JSON the members are sorted by name, and `payload` stands alone between two groups of others.
    before = canonical_parsed({name: value for name, value in fields.items() if name < "payload"})
    after = canonical_parsed({name: value for name, value in fields.items() if name > "payload"})
    return f'{before[:-1]},"payload":{payload},{after[1:]}'


def payload_text(payload: Payload) -> str:
    """Return canonical JSON of a payload, its texts storable.

    Raises StoreError naming a field without a canonical form.
    """
    # In JSON mode pydantic writes NaN in untyped fields as null, which would silently change the evidence.
    for path, number in _numbers(payload.model_dump(mode="python"), payload.kind):
        if not math.isfinite(number):
            raise StoreError(
                f"{number} cannot be recorded",
                where=path,
                remedy="Leave the value out, or say in words why it is missing",
            )
    try:
        return canonical(_plain(payload))
    except PydanticSerializationError as error:
        raise StoreError(
            f"this is not plain data: {error}", where=payload.kind, remedy="Convert arrays to lists"
        ) from error


def _plain(payload: Payload) -> object:
    try:
        return storable_data(payload.model_dump(mode="json"))
    except UnicodeEncodeError:  # pydantic writes surrogates in texts, but not in names of fields
        return PAYLOAD.validate_python(storable_data(payload.model_dump(mode="python"))).model_dump(mode="json")


def _numbers(value: object, path: str) -> Iterator[tuple[str, float]]:
    if isinstance(value, float):
        yield path, value
    elif isinstance(value, Mapping):
        for key, item in cast("Mapping[object, object]", value).items():
            yield from _numbers(item, f"{path}.{key}")
    elif isinstance(value, list | tuple):
        for index, item in enumerate(cast("Sequence[object]", value)):
            yield from _numbers(item, f"{path}[{index}]")


def references(payload: object) -> tuple[ArtefactRef, ...]:
    """Return every distinct ArtefactRef anywhere in a payload's plain data, in order. Raises StoreError."""
    return tuple(dict.fromkeys(_references(payload)))


def _references(value: object) -> Iterator[ArtefactRef]:
    if isinstance(value, Mapping):
        fields = cast("Mapping[str, object]", value)
        if set(fields) == _REF_FIELDS:
            yield _reference(fields)
        else:
            for item in fields.values():
                yield from _references(item)
    elif isinstance(value, list | tuple):
        for item in cast("Sequence[object]", value):
            yield from _references(item)


def _reference(fields: Mapping[str, object]) -> ArtefactRef:
    try:
        return ArtefactRef.model_validate(fields)
    except ValidationError as error:
        raise StoreError(f"a reference to an artefact is malformed: {error}") from error


def append(connection: Connection, clock: Clock, run_id: str, payloads: Sequence[Payload], actor: str) -> list[Event]:
    """Append to a run's chain within the caller's IMMEDIATE transaction, so that no other writer interferes.

    NUL and surrogates in texts become escapes, so the events that are returned may differ from the payloads.

    Raises:
        IntegrityError: the chain does not end where the last append left it.
        StoreError: a payload has no canonical form, or the run was moved to another record.
    """
    head = connection.execute(_HEAD_AND_MOVES, {"run": run_id}).one_or_none()
    if head is not None and head.named_in_moves:
        require_here(connection, run_id)
    seq, previous = _checked_end(connection, run_id, None if head is None else (head.seq, head.sha256))
    appended: list[Event] = []
    rows: list[dict[str, Any]] = []
    to_index: list[EventToIndex] = []
    for payload in payloads:
        seq += 1
        text = payload_text(payload)
        fields: dict[str, Any] = {
            "seq": seq,
            "run_id": run_id,
            "at_utc": utc_text(clock.utc_now()),
            "monotonic_s": clock.monotonic_s(),
            "actor": storable(actor),
            "payload": parse_canonical(text),
            "previous_sha256": previous,
        }
        previous = event_sha256_of_text(fields, text)
        rows.append(fields | {"kind": payload.kind, "payload": text, "sha256": previous})
        to_index.append(EventToIndex(run_id, seq, payload.kind, fields["actor"], fields["payload"]))
        appended.append(Event.model_validate(fields | {"sha256": previous}))
    if appended:
        connection.execute(_INSERT, rows)
        index_events(connection, to_index)
        connection.execute(_MOVE_HEAD, {"run": run_id, "seq": seq, "sha256": previous})
        notify(connection, "chains", run_id)
    return appended


def read_head(connection: Connection, run_id: str) -> tuple[int, str]:
    """Return the sequence number and hash of a run's last event; (0, 64 zeros) before the first.

    Raises IntegrityError if the chain does not end where the last append left it.
    """
    head = connection.execute(_HEAD, {"run": run_id}).one_or_none()
    return _checked_end(connection, run_id, None if head is None else (head.seq, head.sha256))


def _checked_end(connection: Connection, run_id: str, head: tuple[int, str] | None) -> tuple[int, str]:
    """Return the end of a chain, if its row in heads names it. Raises IntegrityError."""
    last = connection.execute(_LAST, {"run": run_id}).one_or_none()
    expected = (0, ROOT) if last is None else (last.seq, last.sha256)
    if head != expected:
        raise IntegrityError(
            f"the chain of run {run_id} does not end where it was left",
            where=f"event {expected[0]}",
            remedy="Run `orthocapture audit verify`; nothing is appended to a chain that was tampered with",
        )
    return expected


def read_events(connection: Connection, run_id: str, after_seq: int) -> list[Event]:
    """Return the events after a sequence number, in order.

    Raises IntegrityError for a row that is not a valid event.
    """
    return [to_event(row) for row in connection.execute(_AFTER, {"run": run_id, "after_seq": after_seq})]


def to_event(row: Row[Any]) -> Event:
    """Return a row as an Event; its hash is not checked. Raises IntegrityError if the row is not a valid event."""
    try:
        return Event(
            seq=row.seq,
            run_id=row.run_id,
            at_utc=row.at_utc,
            monotonic_s=row.monotonic_s,
            actor=row.actor,
            payload=PAYLOAD.validate_python(parse_canonical(row.payload)),
            previous_sha256=row.previous_sha256,
            sha256=row.sha256,
        )
    except (ValidationError, ValueError) as error:
        raise IntegrityError(
            f"event {row.seq} cannot be read: {error}",
            where=f"run {row.run_id}, event {row.seq}",
            remedy="Run `orthocapture audit verify`; a newer version of the software may have written it",
        ) from error
