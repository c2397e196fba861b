"""The journal: every committed change of the record, written to a file of its own before it counts.

The database holds, in the same transaction as the rows, the number of the line that describes them (SQLite's
`user_version`). Whoever holds the database's write lock therefore knows what became of the last line: if the database
has its number, it was committed. If the database has the number before it and no mark says that it was committed, its
writer was interrupted, and the next line says so by the number that it comes after. Anything else means that one of
the two files was overwritten, cut or replaced, and nothing is written any more.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import sqlite3
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import chain, islice, pairwise
from pathlib import Path
from typing import Any, Literal, cast

from service.core.errors import StoreError
from service.store.database.tables import metadata
from service.store.durable_effects import Files
from service.store.records import RecordDamagedError

# The lines of the journal: their text, their chain, and reading them back.
#
# Each line is the JSON text of one write transaction: the rows that it leaves behind, its number, the number of the
# line that the database held before it, and the SHA-256 of the line before it in the file. So no line can be
# altered, removed or moved without breaking the chain. The last line may be followed by a mark, which says whether
# its transaction was committed; the next line takes the mark's place.


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


# What a write transaction changes in the tables that the journal keeps, found by the database itself.
#
# Temporary triggers of the writing connection note the key of every row that is inserted, changed or deleted,
# whatever statement does it. Before the commit, the rows with these keys are read once more.


# The record: whoever adds a table says whether the journal keeps it.
KEPT = ("runs", "events", "artefacts", "jobs", "checkpoints", "timestamps", "accounts", "invitations")
DERIVED = ("event_index", "event_facets", "heads")  # made again from the events
PRESENT_STATE = ("leases", "sessions", "control")  # of processes and screens of the moment
STATED_ELSEWHERE = ("copies",)  # by the place itself, which is asked again
_KEYS = {name: tuple(column.name for column in metadata.tables[name].primary_key.columns) for name in KEPT}
_COLUMNS = {name: tuple(column.name for column in metadata.tables[name].columns) for name in KEPT}
_MOST_KEYS = max(map(len, _KEYS.values()))
_ORDER = {"events": "(SELECT position FROM event_index AS i WHERE i.run_id = t.run_id AND i.seq = t.seq)"}
# Which worker computes a job is of the moment; that it waits again, or has ended, is of the record.
_WHEN = {"jobs": "WHEN NEW.state <> 'running'"}
_TOUCHED = "journal_touched"


def watch_changes(connection: sqlite3.Connection) -> bool:
    """Make the triggers of a connection that is in no transaction. False if the tables do not exist yet."""
    found = connection.execute("SELECT name FROM main.sqlite_master WHERE type = 'table'")
    if not {row[0] for row in found} >= set(KEPT):
        return False
    keys = ", ".join(f"k{index}" for index in range(_MOST_KEYS))
    connection.execute(f"CREATE TEMP TABLE {_TOUCHED} (name, {keys})")
    for name in KEPT:
        for verb, rows in (("INSERT", ("NEW",)), ("UPDATE", ("OLD", "NEW")), ("DELETE", ("OLD",))):
            condition = _WHEN.get(name, "") if verb == "UPDATE" else ""
            notes = "".join(f"INSERT INTO {_TOUCHED} VALUES ('{name}', {_key(name, row)}); " for row in rows)
            connection.execute(
                f"CREATE TEMP TRIGGER journal_{verb.lower()}_{name} AFTER {verb} ON main.{name} {condition} "
                f"BEGIN {notes}END"
            )
    return True


def _key(name: str, row: str) -> str:
    columns = [f"{row}.{column}" for column in _KEYS[name]]
    return ", ".join(columns + ["NULL"] * (_MOST_KEYS - len(columns)))


def forget_changes(connection: sqlite3.Connection) -> None:
    """Forget what earlier transactions of this connection have changed."""
    connection.execute(f"DELETE FROM {_TOUCHED}")


def changed_rows(connection: sqlite3.Connection) -> list[RowImage]:
    """Return the rows that the present transaction has changed, as they are now, in order of their first change."""
    keys = ", ".join(f"k{index}" for index in range(_MOST_KEYS))
    asked = f"SELECT name, {keys} FROM {_TOUCHED} GROUP BY name, {keys} ORDER BY min(rowid)"
    images: list[RowImage] = []
    for name, *key in connection.execute(asked).fetchall():
        columns = _KEYS[name]
        values = key[: len(columns)]
        where = " AND ".join(f"{column} = ?" for column in columns)
        row = connection.execute(f"SELECT {', '.join(_COLUMNS[name])} FROM {name} WHERE {where}", values).fetchone()
        images.append(
            RowImage(name, dict(zip(columns, values, strict=True)), True) if row is None else _image(name, row)
        )
    return images


def every_row(connection: sqlite3.Connection) -> Iterator[RowImage]:
    """Yield all rows that the journal keeps, events in the order in which they were written."""
    for name in KEPT:
        columns = ", ".join(f"t.{column}" for column in _COLUMNS[name])
        order = _ORDER.get(name, ", ".join(_KEYS[name]))
        for row in connection.execute(f"SELECT {columns} FROM {name} AS t ORDER BY {order}"):
            yield _image(name, row)


def _image(name: str, row: Sequence[Value]) -> RowImage:
    return RowImage(name, dict(zip(_COLUMNS[name], row, strict=True)))


def is_known(row: RowImage) -> bool:
    """Return whether the journal keeps this table, and the row has its key and no foreign column."""
    columns = _COLUMNS.get(row.table, ())
    return set(_KEYS.get(row.table, ("",))) <= row.values.keys() <= set(columns)


def key_of(row: RowImage) -> tuple[str, tuple[Value, ...]]:
    """Return the table and the primary key of a row. Raises KeyError for a table that the journal does not keep."""
    return row.table, tuple(row.values[column] for column in _KEYS[row.table])


def row_of_key(table: str, key: Sequence[Value]) -> RowImage:
    """Return a row of which only the key is known."""
    return RowImage(table, dict(zip(_KEYS[table], key, strict=True)))


def apply_row(connection: sqlite3.Connection, row: RowImage) -> None:
    """Bring a known row of another database to what it is in the journal. Raises sqlite3.Error if it is refused."""
    key = _KEYS[row.table]
    if row.gone:
        where = " AND ".join(f"{column} = ?" for column in key)
        connection.execute(f"DELETE FROM {row.table} WHERE {where}", [row.values[column] for column in key])
        return
    columns = list(row.values)  # an older line may have fewer than the table
    marks = ", ".join("?" for _ in columns)
    values = [row.values[column] for column in columns]
    connection.execute(f"INSERT OR REPLACE INTO {row.table} ({', '.join(columns)}) VALUES ({marks})", values)


REBUILD = (
    "Stop every orthocapture process of this data folder and run `orthocapture store rebuild`: it restores what was "
    "recorded and keeps what is there now; then resume the run. Nothing that was captured is lost"
)
_PART = ".part"
_BLOCK_BYTES = 1 << 16
_ROWS_A_LINE = 2000


@dataclass(frozen=True, slots=True)
class Tail:
    """The end of the journal: its last line, and the mark behind it.

    Attributes:
        place: device and inode of the file.
        number: the last line's number.
        after: number of the line that the database held before the last line's transaction.
        sha256: the last line's hash.
        start: the last line's offset in the file.
        end: the offset after it.
        word: the word of its mark; None if it has none.
    """

    place: tuple[int, int]
    number: int
    after: int
    sha256: str
    start: int
    end: int
    word: Word | None


class Journal:
    """The journal of one data folder. Who appends holds the database's write lock."""

    def __init__(self, data_dir: Path, files: Files) -> None:
        self.path = data_dir / NAME
        self._files = files
        self._known: Tail | None = None

    def tail(self) -> Tail | None:
        """Return the end of the journal; None if there is no line yet.

        Raises:
            RecordDamagedError: the file is not the one that this process has read or written before.
            StoreError: it cannot be read.
        """
        try:
            with self.path.open("rb") as stream:
                status = os.fstat(stream.fileno())
                place, known = (status.st_dev, status.st_ino), self._known
                begun_again = known is not None and known.after == 0 and known.place != place
                if known is None or begun_again:  # a beginning that was never committed is replaced by another
                    found = _last(stream.fileno(), status.st_size, place)
                else:
                    found = _following(stream.fileno(), known) if known.place == place else None
        except FileNotFoundError:
            found = None
        except OSError as error:
            raise unreadable(self.path, error) from error
        if found is None and self._known is not None:
            raise RecordDamagedError(
                f"{NAME} was removed, replaced, cut or altered while it was in use; nothing is written any more",
                where=str(self.path),
                remedy=REBUILD,
            )
        self._known = found
        return found

    def require_not_cut(self, tail: Tail | None, held: int) -> None:
        """Raise RecordDamagedError if the journal misses a line of the database; `tail` was read after `held`."""
        if tail is None and held:
            raise RecordDamagedError(
                f"{NAME} is missing or empty, and the database holds its line {held}: the journal was removed or cut",
                where=str(self.path),
                remedy=REBUILD,
            )
        if tail is not None and held > tail.number:
            raise RecordDamagedError(
                f"{NAME} ends at line {tail.number}, and the database holds line {held}: the journal was cut, or "
                "replaced by an older one",
                where=str(self.path),
                remedy=REBUILD,
            )

    def require_not_behind(self, tail: Tail | None, held: int) -> None:
        """Raise RecordDamagedError if the database misses a committed line; `tail` was read before `held`."""
        if tail is None or held >= tail.number or (held == tail.after and tail.word != "committed"):
            return
        raise RecordDamagedError(
            f"the database holds line {held} of {NAME}, which has {tail.number}: the database was overwritten, cut, "
            "or replaced by an older one. The journal has everything",
            where=str(self.path),
            remedy=REBUILD,
        )

    def append(self, rows: Sequence[RowImage], held: int) -> Tail:
        """Append the changes of a transaction durably, before it is committed. Raises OSError, StoreError.

        Args:
            rows: the rows as the transaction leaves them.
            held: number of the line that the database holds, as it was compared with the tail.
        """
        tail = self._known
        assert tail is not None, "a journal is begun before it is continued"
        number = tail.number + 1
        raw = line_bytes(LineFields(number, held, tail.sha256, continued=False, earlier_events=0), rows)
        with _locked(self.path):
            try:
                self._files.append(self.path, tail.end, raw)
                self._files.sync_file(self.path)
            except OSError:
                with suppress(OSError):  # what cannot be synced is not committed
                    self._files.append(self.path, tail.end, b"")
                raise
        sha256 = hashlib.sha256(raw).hexdigest()
        self._known = Tail(tail.place, number, held, sha256, tail.end, tail.end + len(raw), None)
        return self._known

    def begin(self, rows: Iterable[RowImage], earlier_events: int) -> Tail:
        """Begin the journal with all rows of a database that has none, before the first commit.

        A beginning that was never committed is replaced. Raises OSError.
        """
        part = self.path.with_name(NAME + _PART)
        self._files.remove(part)
        last: list[Tail] = []
        self._files.write(part, _beginning(rows, earlier_events, last))
        self._files.sync_file(part)
        self._files.rename(part, self.path)
        self._files.sync_directory(self.path.parent)
        status = self.path.stat()
        self._known = replace(last[0], place=(status.st_dev, status.st_ino))
        return self._known

    def mark(self, tail: Tail, word: Word) -> None:
        """Say what became of the last line's transaction, unless another line follows already.

        The mark is not synced: it helps to distinguish an interrupted commit from a database that was replaced.
        Without it, the database alone decides.
        """
        raw = mark_bytes(Mark(word, tail.number, tail.sha256))
        with suppress(OSError), _locked(self.path) as descriptor:
            status = os.fstat(descriptor)
            if ((status.st_dev, status.st_ino), status.st_size) == (tail.place, tail.end):
                self._files.append(self.path, tail.end, raw)


def _beginning(rows: Iterable[RowImage], earlier_events: int, last: list[Tail]) -> Iterator[bytes]:
    """Yield the lines of a beginning; the tail that they make is put into `last`, but for its place."""
    previous, end = FIRST, 0
    for number, (block, following) in enumerate(pairwise(chain(_blocks(rows), (None,))), start=1):
        earlier = earlier_events if number == 1 else 0
        fields = LineFields(number, 0, previous, continued=following is not None, earlier_events=earlier)
        raw = line_bytes(fields, block or ())
        previous, end = hashlib.sha256(raw).hexdigest(), end + len(raw)
        last[:] = [Tail((0, 0), number, 0, previous, end - len(raw), end, None)]
        yield raw


def _blocks(rows: Iterable[RowImage]) -> Iterator[list[RowImage]]:
    block: list[RowImage] = []
    for row in rows:
        block.append(row)
        if len(block) == _ROWS_A_LINE:
            yield block
            block = []
    yield block


@contextmanager
def _locked(path: Path) -> Generator[int]:
    """Hold the lock of the file: a mark and the next line would be written to the same place."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield descriptor
    finally:
        os.close(descriptor)


def read_tail(path: Path) -> Tail | None:
    """Return the end of any journal, such as a copy; None if the file has no line or does not exist.

    Raises RecordDamagedError if a line near the end does not follow the one before it, OSError.
    """
    try:
        with path.open("rb") as stream:
            status = os.fstat(stream.fileno())
            return _last(stream.fileno(), status.st_size, (status.st_dev, status.st_ino))
    except FileNotFoundError:
        return None


def _last(descriptor: int, size: int, place: tuple[int, int]) -> Tail | None:
    """Return the tail of a file that was not read before, from its end; None if it has no line."""
    length = _BLOCK_BYTES
    while True:
        begin = max(0, size - length)
        content = os.pread(descriptor, size - begin, begin)
        first = 0 if begin == 0 else content.find(b"\n") + 1
        if begin == 0 or first:
            found = _tail_in(content[first:], begin + first, place)
            if found is not None or begin == 0:
                return found
        length *= 4


def _tail_in(content: bytes, offset: int, place: tuple[int, int]) -> Tail | None:
    found: Tail | None = None
    for raw in _split(content):
        found = _next(found, raw, offset, place)
        offset += len(raw)
    return found


def _following(descriptor: int, known: Tail) -> Tail | None:
    """Return the tail of a file that has grown since; None if the last line that is known is not there any more."""
    content = os.pread(descriptor, max(0, os.fstat(descriptor).st_size - known.start), known.start)
    lines = _split(content)
    if not lines or hashlib.sha256(lines[0]).hexdigest() != known.sha256:
        return None
    found: Tail | None = replace(known, word=None)
    offset = known.end
    for raw in lines[1:]:
        found = _next(found, raw, offset, known.place)
        offset += len(raw)
    return found


def _split(content: bytes) -> list[bytes]:
    """Return the pieces of the file, each up to and with its line end."""
    *whole, rest = content.split(b"\n")
    pieces = [piece + b"\n" for piece in whole]
    return [*pieces, rest] if rest else pieces


def _next(found: Tail | None, raw: bytes, offset: int, place: tuple[int, int]) -> Tail | None:
    """Return the tail with one more piece of the file: a mark, a line, or what a power cut left, which is void."""
    mark = parse_mark(raw)
    if mark is not None:
        fits = found is not None and (mark.number, mark.sha256) == (found.number, found.sha256)
        return replace(found, word=mark.word) if found is not None and fits else found
    line = parse_line(raw, offset + len(raw))
    if line.problem == UNREADABLE or not raw.endswith(b"\n"):
        return found
    follows = found is None or (line.number, line.previous_sha256) == (found.number + 1, found.sha256)
    if line.problem or not follows:
        raise RecordDamagedError(
            f"line {line.number} of {NAME} was altered; nothing is written any more",
            where=NAME,
            remedy=REBUILD,
        )
    return Tail(place, line.number, line.after, line.sha256, offset, line.end, None)
