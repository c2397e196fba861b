"""The journal of a data folder for its writers: append before the commit, mark after it, compare with the database.

The database holds, in the same transaction as the rows, the number of the line that describes them (SQLite's
`user_version`). Whoever holds the database's write lock therefore knows what became of the last line: if the database
has its number, it was committed. If the database has the number before it and no mark says that it was committed, its
writer was interrupted, and the next line says so by the number that it comes after. Anything else means that one of
the two files was overwritten, cut or replaced, and nothing is written any more.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import chain, pairwise
from pathlib import Path

from service.store.durable_effects import Files
from service.store.journal.lines import (
    FIRST,
    NAME,
    UNREADABLE,
    LineFields,
    Mark,
    RowImage,
    Word,
    line_bytes,
    mark_bytes,
    parse_line,
    parse_mark,
    unreadable,
)
from service.store.records import RecordDamagedError

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
