"""The lines of the journal: their text, their chain, and reading them back.

Each line is the JSON text of one write transaction: the rows that it leaves behind, its number, the number of the
line that the database held before it, and the SHA-256 of the line before it in the file. So no line can be altered,
removed or moved without breaking the chain. The last line may be followed by a mark, which says whether its
transaction was committed; the next line takes the mark's place.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Literal, cast

from service.core.errors import StoreError

NAME = "journal.jsonl"
UNREADABLE = "it cannot be read"
FIRST = "0" * 64  # stands for the line before the first
Value = str | int | float | None
Word = Literal["committed", "withdrawn"]
_JSON = json.JSONEncoder(ensure_ascii=False, allow_nan=False, sort_keys=True, separators=(",", ":"))


@dataclass(frozen=True, slots=True)
class RowImage:
    """A row as a transaction left it, or its key if the transaction deleted it."""

    table: str
    values: Mapping[str, Value]
    gone: bool = False


@dataclass(frozen=True, slots=True)
class JournalLine:
    """One line.

    Attributes:
        number: from 1, by its place in the file.
        after: number of the line that the database held when this one was written; 0 for none.
        rows: what its transaction changed.
        continued: whether the next line belongs to the same transaction.
        earlier_events: of a journal's first line: how many events were recorded before there was a journal.
        sha256: of its bytes.
        end: offset in the file after it.
        problem: why it cannot be read or does not follow the line before it; "" if it is as it was written.
    """

    number: int
    after: int
    rows: tuple[RowImage, ...]
    continued: bool
    earlier_events: int
    sha256: str
    end: int
    problem: str = ""


@dataclass(frozen=True, slots=True)
class Mark:
    """What became of the last line's transaction."""

    word: Word
    number: int
    sha256: str  # of the line


@dataclass(frozen=True, slots=True)
class Ending:
    """What follows the last line: a mark, nothing, or bytes that are neither, as a power cut may leave."""

    mark: Mark | None
    torn_bytes: int


@dataclass(frozen=True, slots=True)
class LineFields:
    """What a line says beside its rows."""

    number: int
    after: int
    previous_sha256: str
    continued: bool = False
    earlier_events: int = 0


def line_bytes(fields: LineFields, rows: Sequence[RowImage]) -> bytes:
    """The bytes of a line."""
    data: dict[str, Any] = {
        "number": fields.number,
        "after": fields.after,
        "previous_sha256": fields.previous_sha256,
        "rows": [{"table": row.table, "gone" if row.gone else "row": dict(row.values)} for row in rows],
    }
    if fields.continued:
        data["continued"] = True
    if fields.earlier_events:
        data["earlier_events"] = fields.earlier_events
    return _JSON.encode(data).encode() + b"\n"


def mark_bytes(mark: Mark) -> bytes:
    """The bytes of a mark."""
    return _JSON.encode({"mark": mark.word, "number": mark.number, "sha256": mark.sha256}).encode() + b"\n"


def parse_line(raw: bytes, number: int, previous_sha256: str, end: int) -> JournalLine:
    """A line from its bytes, with what is wrong with it; `number` and `previous_sha256` are those it should say."""
    sha256 = hashlib.sha256(raw).hexdigest()
    try:
        data: Any = json.loads(raw)
        fields = LineFields(
            int(data["number"]),
            int(data["after"]),
            str(data["previous_sha256"]),
            bool(data.get("continued", False)),
            int(data.get("earlier_events", 0)),
        )
        rows = tuple(_row(item) for item in data["rows"])
        written = line_bytes(fields, rows)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return JournalLine(
            number, 0, (), continued=False, earlier_events=0, sha256=sha256, end=end, problem=UNREADABLE
        )
    problem = ""
    if (fields.number, fields.previous_sha256) != (number, previous_sha256) or not 0 <= fields.after < number:
        problem = "it does not follow the line before it"
    elif raw != written:
        problem = "it is not as it was written: its text was altered"
    return JournalLine(number, fields.after, rows, fields.continued, fields.earlier_events, sha256, end, problem)


def _row(item: Any) -> RowImage:
    gone = "gone" in item
    values = cast("dict[str, object]", item["gone" if gone else "row"])
    if any(not isinstance(value, str | int | float | None) for value in values.values()):
        raise TypeError("a column is of another kind")
    return RowImage(str(item["table"]), cast("dict[str, Value]", values), gone)


def said_by(raw: bytes) -> LineFields | None:
    """What a line says of itself; None if it is no line."""
    try:
        data: Any = json.loads(raw)
        return LineFields(int(data["number"]), int(data["after"]), str(data["previous_sha256"]))
    except (ValueError, TypeError, KeyError, RecursionError):
        return None


def parse_mark(raw: bytes) -> Mark | None:
    """A mark from its bytes; None if these are not exactly those of a mark."""
    try:
        data: Any = json.loads(raw)
        mark = Mark(data["mark"], int(data["number"]), str(data["sha256"]))
    except (ValueError, TypeError, KeyError, RecursionError):
        return None
    return mark if mark.word in ("committed", "withdrawn") and mark_bytes(mark) == raw else None


def read_lines(path: Path) -> Iterator[JournalLine | Ending]:
    """Every line in order, then the ending; nothing for a file that does not exist. Raises StoreError.

    An unreadable line with others after it is a line with a problem; at the end of the file it belongs to the ending.
    """
    try:
        with path.open("rb") as stream:
            yield from _lines(stream)
    except FileNotFoundError:
        return
    except OSError as error:
        raise unreadable(path, error) from error


def _lines(stream: Iterator[bytes]) -> Iterator[JournalLine | Ending]:
    number, previous, end = 0, FIRST, 0
    waiting: list[tuple[bytes, int]] = []  # what may be the ending: a mark, or what a power cut left
    for raw in stream:
        end += len(raw)
        line = parse_line(raw, number + 1, previous, end)
        if line.problem == UNREADABLE or not raw.endswith(b"\n"):
            waiting.append((raw, end))
            continue
        for lost, at in waiting:  # lines follow, so this was no ending
            number, previous = number + 1, hashlib.sha256(lost).hexdigest()
            yield parse_line(lost, number, previous, at)
        if waiting:
            line = parse_line(raw, number + 1, previous, end)
            waiting = []
        number, previous = number + 1, line.sha256
        yield line
    mark = parse_mark(waiting[0][0]) if waiting else None
    if mark is not None and (mark.number, mark.sha256) != (number, previous):
        mark = None
    yield Ending(mark, sum(len(raw) for raw, _ in waiting[(mark is not None) :]))


def first_lines(path: Path, number: int) -> Iterator[bytes]:
    """The bytes of the first `number` lines, as they are, without a mark. Raises OSError."""
    with path.open("rb") as stream:
        yield from islice((raw for raw in stream if parse_mark(raw) is None), number)


def unreadable(path: Path, error: OSError) -> StoreError:
    """The error for a journal that cannot be read."""
    return StoreError(
        f"the journal cannot be read: {error.strerror or error}",
        where=str(path),
        remedy="Check the permissions of the data folder",
    )
