"""Checks of the files of a data folder: recorded files, the write-ahead log of SQLite, and the journal."""

from __future__ import annotations

import hashlib
import sqlite3
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Protocol

from sqlalchemy import Connection

from service.core.errors import StoreError
from service.store.artefacts import TEMPORARY, hash_file, relative_path
from service.store.database.engine import DATABASE_NAME, LOOK
from service.store.journal import (
    FIRST,
    NAME,
    Ending,
    JournalLine,
    Mark,
    RowImage,
    Value,
    every_row,
    is_known,
    key_of,
    read_lines,
    row_of_key,
)
from service.store.records import SITE
from service.store.verification.chain_checks import Fault, FileState

Progress = Callable[[str, int, int], None]  # (activity, bytes done, bytes in total)


class Elsewhere(Protocol):
    """Another place that may have a file that is not in the folder."""

    def state(self, sha256: str, shown: str) -> FileState:
        """Return what is found of a file there; its `problem` says why nothing was."""
        ...


def hash_files(
    folder: Path,
    artefact_rows: Iterable[Mapping[str, Any]],
    progress: Progress | None,
    elsewhere: Elsewhere | None = None,
) -> dict[str, FileState]:
    """Hash every file that the rows name, by its recorded SHA-256; one that is not here is looked for elsewhere."""
    wanted = {str(row["sha256"]): int(row["size_bytes"]) for row in artefact_rows}
    total, done = sum(wanted.values()), 0
    states: dict[str, FileState] = {}
    for sha256, size in wanted.items():
        states[sha256] = _file_state(folder, sha256, elsewhere)
        done += size
        if progress is not None:
            progress("hashing files again", done, total)
    return states


def _file_state(folder: Path, sha256: str, elsewhere: Elsewhere | None) -> FileState:
    try:
        name = relative_path(sha256)
    except StoreError:
        return FileState(sha256, "", 0, "the row names no SHA-256")
    path = folder / name
    shown = str(Path(folder.name) / name)
    if path.is_symlink() or not path.is_file():
        if elsewhere is not None and not path.is_symlink() and not path.exists():
            return elsewhere.state(sha256, shown)
        return FileState(shown, "", 0, "the file is missing")
    try:
        digest, size = hash_file(path)
    except OSError as error:
        return FileState(shown, "", 0, f"the file cannot be read: {error.strerror}")
    return FileState(shown, digest, size, "")


def elsewhere_notes(states: Iterable[FileState]) -> list[str]:
    """Return notes on the files that are not in the folder, by how each was checked; none if all are here."""
    found = list(states)
    read = sum(state.how == "fetched" and not state.problem for state in found)
    stated = sum(state.how == "stated" and not state.problem for state in found)
    only = "in the object store alone"
    notes: list[str] = []
    if read:
        notes.append(f"{read} of {len(found)} files are {only}: their content was fetched and hashed")
    if stated:
        notes.append(
            f"{stated} of {len(found)} files are {only} and were NOT read: the store itself states their SHA-256"
        )
    return notes


def unread_files(states: Iterable[FileState]) -> list[str]:
    """Return a sentence on the files that only an object store has that is away; none if there are none."""
    found = list(states)
    away = [state for state in found if state.how == "away"]
    if not away:
        return []
    return [
        f"{len(away)} of {len(found)} files are not here and are not compared, because their object store is away: "
        f"{away[0].problem}"
    ]


def unlisted_files(folder: Path, listed: frozenset[str]) -> tuple[list[str], list[Fault]]:
    """Return (notes, faults) on files that no row names.

    Leftovers of crashes are notes: partial and unrecorded files.
    """
    notes: list[str] = []
    foreign: list[Fault] = []
    for path in sorted(path for path in folder.rglob("*") if not path.is_dir() or path.is_symlink()):
        relative = path.relative_to(folder)
        shown = str(Path(folder.name) / relative)
        if relative.parts[0] == TEMPORARY and path.suffix == ".part":
            notes.append(f"{shown}: left over from an interrupted write; no record refers to it")
        elif path.name in listed and relative == relative_path(path.name):
            continue
        elif not path.is_symlink() and path.is_file() and hash_file(path)[0] == path.name:
            notes.append(
                f"{shown}: stored but never recorded (interrupted before the record); no record refers to it"
            )
        else:
            foreign.append(Fault(None, None, shown, "this file is not in the evidence and is not a crash's leftover"))
    return notes, foreign


# Find commits in a database's write-ahead log that SQLite would silently ignore.
#
# SQLite reads the log up to the first frame with a wrong checksum and takes the rest for a write cut off by a power
# failure. After a damaged frame, however, whole commits may follow. The format is described in
# https://sqlite.org/fileformat2.html#walformat.


_HEADER = struct.Struct(">8I")
_FRAME = struct.Struct(">6I")
_MAGIC = 0x377F0682  # the last bit gives the byte order of the checksum
_WORD = 0xFFFFFFFF
_HEAD_DAMAGED = -1


def wal_findings(data_dir: Path) -> tuple[list[Fault], list[str]]:
    """Return faults and notes on commits that SQLite ignores. Raises StoreError if the log cannot be read.

    One such commit may be the rest of a write cut off by a power failure, because frames need not reach the disk in
    order; it is a note. Two or more mean damage, because a commit begins only when the one before it is on disk.
    """
    log = data_dir / f"{DATABASE_NAME}-wal"
    # Read again if something is found, because a process may be writing to the log.
    commits = _passed_over(log) and _passed_over(log)
    if commits == _HEAD_DAMAGED:
        return [Fault(None, None, log.name, "its head is damaged: what was committed last is lost")], []
    if commits == 1:
        return [], [f"{log.name}: a commit behind a damaged frame is not read, as after a power cut"]
    return (
        [Fault(None, None, log.name, f"{commits} commits behind a damaged frame are lost")] if commits else []
    ), []


def _passed_over(log: Path) -> int:
    """Return the number of commits after a damaged frame of a write-ahead log, or _HEAD_DAMAGED; 0 without a log."""
    try:
        content = log.read_bytes()
    except FileNotFoundError:
        return 0
    except OSError as error:
        raise StoreError(
            f"the write-ahead log cannot be read: {error.strerror}", where=str(log), remedy=LOOK
        ) from error
    if len(content) <= _HEADER.size:
        return 0
    magic, _format, page, _checkpoint, *salts, one, two = _HEADER.unpack_from(content)
    order = ">" if magic & 1 else "<"
    sums = _checksum(content[:24], (0, 0), order)
    if magic & ~1 != _MAGIC or sums != (one, two):
        return _HEAD_DAMAGED
    size = _FRAME.size + page
    commits, sound = 0, True
    for start in range(_HEADER.size, len(content) - size + 1, size):
        _number, pages, *of_frame, one, two = _FRAME.unpack_from(content, start)
        if sound:
            sums = _checksum(content[start : start + 8], sums, order)
            sums = _checksum(content[start + _FRAME.size : start + size], sums, order)
            sound = of_frame == salts and sums == (one, two)
        if not sound and of_frame == salts and pages:  # frames with other salts are from an earlier use of the file
            commits += 1
    return commits


def _checksum(data: bytes, sums: tuple[int, int], order: str) -> tuple[int, int]:
    one, two = sums
    words = struct.unpack(f"{order}{len(data) // 4}I", data)
    for first, second in zip(words[::2], words[1::2], strict=True):
        one = (one + first + two) & _WORD
        two = (two + second + one) & _WORD
    return one, two


@dataclass(frozen=True, slots=True)
class Survey:
    """A journal, read from its first line to its last.

    Attributes:
        last: number of the last line that can be read; 0 without a line.
        before_last: number of the line that the database held before the last line's transaction.
        void: numbers of the lines whose transaction was never committed, as the lines after them say.
        problems: (number, what is wrong) of each line that is not as it was written.
        mark: the mark at the end, which says what became of the last line; None if there is none.
        torn_bytes: number of bytes at the end that are no line, as after a power cut.
        earlier_events: number of events that were recorded before the journal was started.
    """

    last: int
    before_last: int
    void: frozenset[int]
    problems: tuple[tuple[int, str], ...]
    mark: Mark | None
    torn_bytes: int
    earlier_events: int

    def is_behind(self, held: int) -> bool:
        """Return whether something that was committed is missing from a database that holds line `held`."""
        committed = self.mark is not None and self.mark.word == "committed"
        return held < self.last and (held != self.before_last or committed)


class _Chain:
    """Follows the lines of a journal, and says of each damaged one what is wrong.

    A line that does not follow the one before it does not show which of the two was altered. The line after both, or
    the mark, vouches for the second one; then it was the first.
    """

    def __init__(self) -> None:
        self.problems: dict[int, str] = {}
        self._number, self._sha256 = 0, FIRST
        self._doubtful: int | None = None  # the line before the last one, or the last one, was altered

    def follow(self, line: JournalLine) -> int:
        """Look at the next line; returns its number, or 0 if it stands where it was not written."""
        expected, follows = self._number + 1, line.previous_sha256 == self._sha256
        number = expected
        if self._doubtful is not None:
            self._resolve(vouched=follows)
        if line.problem:
            self.problems[number] = line.problem
        elif follows and line.number != expected:
            self.problems[number] = "its number was altered"
        elif line.number > expected:
            number = line.number
            self.problems[expected] = _missing(expected, number - 1)
        elif line.number < expected:
            self.problems[expected] = f"line {line.number} stands here, out of its place"
            return 0
        elif not follows and self._number not in self.problems:
            self._doubtful = number
        if number not in self.problems and not all(map(is_known, line.rows)):
            self.problems[number] = "it has a row that no version writes: its text was altered"
        self._number, self._sha256 = number, line.sha256
        return number

    def end(self, mark: Mark | None) -> None:
        """Look at the end of the file."""
        if self._doubtful is not None:
            self._resolve(vouched=mark is not None)

    def _resolve(self, *, vouched: bool) -> None:
        assert self._doubtful is not None
        if self._doubtful > 1:
            self.problems.setdefault(
                self._doubtful - 1, "it is not the line that the next one follows: it was altered"
            )
        if self._doubtful == 1 or not vouched:
            self.problems.setdefault(self._doubtful, "it does not follow the line before it")
        self._doubtful = None


def _missing(first: int, last: int) -> str:
    return "it is missing" if first == last else f"it and all up to line {last} are missing"


def survey(path: Path) -> Survey:
    """Read a journal; one that does not exist is like an empty one. Raises StoreError if it cannot be read."""
    chain = _Chain()
    last = before_last = earlier_events = 0
    group: list[int] = []  # lines of the present transaction
    before: list[int] = []  # lines of the transaction before it
    void: set[int] = set()
    ending = Ending(None, 0)
    for item in read_lines(path):
        if isinstance(item, Ending):
            ending = item
            continue
        number = chain.follow(item)
        if not number:
            continue
        after = last if item.problem else item.after
        if not group and before and after != before[-1]:
            if after == before_last:
                void.update(before)
            elif before[-1] not in chain.problems and number - 1 == before[-1]:
                chain.problems.setdefault(number, "it does not come after the line that the database held")
        group.append(number)
        earlier_events = earlier_events or item.earlier_events
        if not item.continued:
            last, before_last, before, group = number, after, group, []
    chain.end(ending.mark)
    problems = tuple(sorted(chain.problems.items()))
    return Survey(last, before_last, frozenset(void), problems, ending.mark, ending.torn_bytes, earlier_events)


def committed_rows(path: Path, surveyed: Survey, until: int) -> Iterator[RowImage]:
    """Yield the rows of all committed lines up to number `until` that are as they were written, in their order."""
    left_out = surveyed.void | {number for number, _ in surveyed.problems}
    for item in read_lines(path):
        if isinstance(item, JournalLine) and 0 < item.number <= until and item.number not in left_out:
            yield from item.rows


_MOST_OF_A_TABLE = 10  # faults of one table that are named one by one
_OF_A_WORKER = {"worker", "token", "until_utc_s", "host", "boot", "pid", "process_started_s"}
_OF_THE_MOMENT = {"state", "tries", "started_utc", "ended_utc", "ended_seq", "error", *_OF_A_WORKER}  # while it waits
_Key = tuple[str, tuple[Value, ...]]


def journal_findings(
    data_dir: Path, connection: Connection, run_ids: Sequence[str] | None, held_now: Callable[[], int]
) -> tuple[list[Fault], list[str]]:
    """Return faults and notes on differences between a database and its journal.

    Args:
        data_dir: the data folder.
        connection: the snapshot that is verified.
        run_ids: the runs whose rows are compared, beside those of the site; None for all.
        held_now: reads the number of the line that the database holds by now, for a process may be writing.
    """
    raw = connection.connection.driver_connection
    assert isinstance(raw, sqlite3.Connection)  # the engine's own driver
    (held,) = raw.execute("PRAGMA user_version").fetchone()
    surveyed = survey(data_dir / NAME)
    if surveyed.is_behind(held_now()):
        surveyed = survey(data_dir / NAME)  # a line that was being withdrawn or written
    faults = [Fault(None, None, f"{NAME}, line {number}", what) for number, what in surveyed.problems]
    if surveyed.last == 0 and held:
        faults.append(Fault(None, None, NAME, f"the journal is missing or empty; the database holds its line {held}"))
        return faults, []
    if surveyed.last == 0 and not surveyed.problems:
        begun = raw.execute("SELECT 1 FROM events LIMIT 1").fetchone() is not None
        return [], [f"there is no {NAME} yet: the next write begins it"] if begun else []
    if surveyed.last < held:
        faults.append(Fault(None, None, NAME, f"it ends at line {surveyed.last}, the database holds line {held}"))
    elif surveyed.is_behind(now := held_now()):
        faults.append(Fault(None, None, DATABASE_NAME, _behind(surveyed, now)))
    if surveyed.problems:  # the rows of a damaged line would look as if they had been put into the database
        return faults, list(_notes(surveyed, held_now()))
    wanted = None if run_ids is None else {*run_ids, SITE}
    rows = committed_rows(data_dir / NAME, surveyed, held)
    return faults + list(_differences(raw, rows, wanted)), list(_notes(surveyed, held_now()))


def _behind(surveyed: Survey, held: int) -> str:
    return (
        f"it holds line {held} of {NAME}, which has {surveyed.last}: the database was overwritten, cut, or replaced "
        "by an older one; `orthocapture store rebuild` restores it"
    )


def _notes(surveyed: Survey, held: int) -> Iterator[str]:
    if surveyed.earlier_events:
        yield f"{NAME}: {surveyed.earlier_events} events were recorded before the journal was begun"
    if surveyed.torn_bytes:
        yield f"{NAME}: its end is cut off, as after a power cut"
    interrupted = len(surveyed.void) + (held == surveyed.before_last and not surveyed.is_behind(held))
    if interrupted:
        lines = "1 line was" if interrupted == 1 else f"{interrupted} lines were"
        yield f"{NAME}: {lines} never committed; the writer was interrupted"


def _differences(
    connection: sqlite3.Connection, rows: Iterator[RowImage], wanted: set[str] | None
) -> Iterator[Fault]:
    """Yield a fault for each row that is missing from the database, differs in it, or is not in the journal."""
    expected: dict[_Key, _Written] = {}
    for row in rows:
        if not _is_of(row, wanted):
            continue
        key = key_of(row)
        if row.gone:
            expected.pop(key, None)
        else:
            expected[key] = _written(row)
    told: Counter[str] = Counter()
    for row in every_row(connection):
        if not _is_of(row, wanted):
            continue
        written = expected.pop(key_of(row), None)
        if written is None:
            yield from _fault(told, row, "is not in the journal: it was put into the database past it")
        elif written.digest != _digest(row, written.columns):
            yield from _fault(told, row, "is not as it is in the journal: it was altered")
    for key in expected:
        row = row_of_key(*key)
        yield from _fault(told, row, "is in the journal and no longer in the database: it was removed")
    for table, number in told.items():
        if number > _MOST_OF_A_TABLE:
            more = number - _MOST_OF_A_TABLE
            yield Fault(None, None, DATABASE_NAME, f"{more} more rows of {table} are not as they are in the journal")


def _is_of(row: RowImage, wanted: set[str] | None) -> bool:
    return wanted is None or row.values.get("run_id", SITE) in wanted


@dataclass(frozen=True, slots=True)
class _Written:
    """The columns of a row that must still be as they were written, and a digest: there may be many rows."""

    columns: tuple[str, ...]  # an older line may have fewer than the table
    digest: bytes


def _written(row: RowImage) -> _Written:
    waits = row.table == "jobs" and row.values["state"] not in ("finished", "failed")
    columns = _sorted(tuple(row.values), frozenset(_OF_THE_MOMENT) if waits else frozenset())
    return _Written(columns, _digest(row, columns))


@cache
def _sorted(columns: tuple[str, ...], without: frozenset[str]) -> tuple[str, ...]:
    return tuple(sorted(set(columns) - without))


def _digest(row: RowImage, columns: tuple[str, ...]) -> bytes:
    return hashlib.sha256(repr([row.values[column] for column in columns]).encode()).digest()


def _fault(told: Counter[str], row: RowImage, what: str) -> Iterator[Fault]:
    told[row.table] += 1
    if told[row.table] > _MOST_OF_A_TABLE:
        return
    run_id = row.values.get("run_id")
    seq = row.values.get("seq", row.values.get("enqueued_seq"))
    table = "" if run_id is not None else f"{DATABASE_NAME}, {row.table}"
    shown = "the event" if row.table == "events" else f"its row of {row.table}"
    yield Fault(
        None if run_id is None else str(run_id), seq if isinstance(seq, int) else None, table, f"{shown} {what}"
    )
