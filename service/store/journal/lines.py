"""The lines of the journal: their text, their chain, and reading them back.

Each line is the JSON text of one write transaction: the rows that it leaves behind, its number, the number of the
line that the database held before it, and the SHA-256 of the line before it in the file. So no line can be altered,
removed or moved without breaking the chain. The last line may be followed by a mark, which says whether its
transaction was committed; the next line takes the mark's place.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
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
_VALUE_TYPES = frozenset({str, int, float, bool, type(None)})  # what JSON has besides lists and objects
_JSON = json.JSONEncoder(ensure_ascii=False, allow_nan=False, sort_keys=True, separators=(",", ":"))


@dataclass(frozen=True, slots=True)
class RowImage:
    """A row as a transaction left it, or its key if the transaction deleted it."""

    table: str
    values: Mapping[str, Value]
    gone: bool = False


@dataclass(frozen=True, slots=True)
class LineFields:
    """The fields of a line besides its rows.

    Attributes:
        number: the line's number from 1, as it says; 0 if it cannot be read.
        after: number of the line that the database held when this one was written; 0 for none.
        previous_sha256: hash of the line before it, as it says.
        continued: true if the next line belongs to the same transaction.
        earlier_events: number of events that were recorded before there was a journal; only in its first line.
    """

    number: int
    after: int
    previous_sha256: str
    continued: bool
    earlier_events: int


@dataclass(frozen=True, slots=True)
class JournalLine(LineFields):
    """One line of the journal.

    Attributes:
        rows: the rows that its transaction changed.
        sha256: hash of its bytes.
        end: the offset in the file after it.
        problem: the reason why it is not as it was written, as far as it shows by itself; "" if it does not.
    """

    rows: tuple[RowImage, ...]
    sha256: str
    end: int
    problem: str = ""


@dataclass(frozen=True, slots=True)
class Mark:
    """The mark behind the last line, which says what became of its transaction."""

    word: Word
    number: int
    sha256: str  # hash of the line


@dataclass(frozen=True, slots=True)
class Ending:
    """The end after the last line: a mark, nothing, or bytes that are neither, as a power cut may leave."""

    mark: Mark | None
    torn_bytes: int


def line_bytes(fields: LineFields, rows: Sequence[RowImage]) -> bytes:
    """Return the bytes of a line."""
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
    """Return the bytes of a mark."""
    return _JSON.encode({"mark": mark.word, "number": mark.number, "sha256": mark.sha256}).encode() + b"\n"


def parse_line(raw: bytes, end: int) -> JournalLine:
    """Return a line from its bytes, which end at this offset of the file, with what is wrong with it."""
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
        return JournalLine(0, 0, "", False, 0, (), sha256, end, UNREADABLE)
    problem = "" if raw == written else "it is not as it was written: its text was altered"
    said = fields.number, fields.after, fields.previous_sha256, fields.continued, fields.earlier_events
    return JournalLine(*said, rows, sha256, end, problem)


def _row(item: Any) -> RowImage:
    gone = "gone" in item
    values = cast("dict[str, object]", item["gone" if gone else "row"])
    if not _VALUE_TYPES.issuperset(map(type, values.values())):
        raise TypeError("a column is of another kind")
    return RowImage(str(item["table"]), cast("dict[str, Value]", values), gone)


def parse_mark(raw: bytes) -> Mark | None:
    """Return a mark from its bytes; None if these are not exactly those of a mark."""
    try:
        data: Any = json.loads(raw)
        mark = Mark(data["mark"], int(data["number"]), str(data["sha256"]))
    except (ValueError, TypeError, KeyError, RecursionError):
        return None
    return mark if mark.word in ("committed", "withdrawn") and mark_bytes(mark) == raw else None


def read_lines(path: Path) -> Iterator[JournalLine | Ending]:
    """Yield every line in order, then the ending; nothing for a file that does not exist. Raises StoreError.

    An unreadable line with others after it is a line with a problem; at the end of the file it belongs to the ending.
    """
    try:
        with path.open("rb") as stream:
            yield from _lines(stream)
    except FileNotFoundError:
        return
    except OSError as error:
        raise unreadable(path, error) from error


def _lines(stream: Iterable[bytes]) -> Iterator[JournalLine | Ending]:
    end, last = 0, (0, FIRST)
    waiting: list[tuple[bytes, int]] = []  # lines that may be the ending: a mark, or what a power cut left
    for raw in stream:
        end += len(raw)
        line = parse_line(raw, end)
        if line.problem == UNREADABLE or not raw.endswith(b"\n"):
            waiting.append((raw, end))
            continue
        yield from (parse_line(lost, at) for lost, at in waiting)  # lines follow, so this was no ending
        waiting = []
        last = line.number, line.sha256
        yield line
    mark = parse_mark(waiting[0][0]) if waiting else None
    if mark is not None and (mark.number, mark.sha256) != last:
        mark = None
    yield Ending(mark, sum(len(raw) for raw, _ in waiting[(mark is not None) :]))


def first_lines(path: Path, number: int) -> Iterator[bytes]:
    """Yield the bytes of the first `number` lines, as they are, without a mark. Raises OSError."""
    with path.open("rb") as stream:
        yield from islice((raw for raw in stream if parse_mark(raw) is None), number)


def unreadable(path: Path, error: OSError) -> StoreError:
    """Return the error for a journal that cannot be read."""
    return StoreError(
        f"the journal cannot be read: {error.strerror or error}",
        where=str(path),
        remedy="Check the permissions of the data folder",
    )
