"""Corrections of recorded values: the original stays, and the new value is recorded with who, when and why."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from service.audit.overview.findings import value_at, value_text
from service.audit.record.event_rows import one_event
from service.core.errors import DataError
from service.core.records.events import Event, RecordCorrected
from service.core.text.files import parse_json
from service.core.text.words import reason_of
from service.store.store import Store

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
    """The fields that can be corrected, each with its value as text; a few hundred at most."""
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
