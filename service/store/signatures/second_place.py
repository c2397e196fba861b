"""The second place of signatures: copies of log and journal that a thread keeps elsewhere, as on a share.

A place can be away: the folder cannot be reached, is full or read-only, or hangs as a share does whose server is
gone. That is reported and tried again, and stops nothing.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Lock, Thread
from typing import Protocol, Self

from service.core.errors import IntegrityError, StoreError
from service.core.words import time_here
from service.store.durable_effects import Clock, DurableFiles, Files, Signal, utc_text
from service.store.journal import NAME as JOURNAL_NAME
from service.store.journal import Tail, read_tail
from service.store.signatures.log import NAME, copying_alone, unreadable
from service.store.verification.chain_checks import Fault

AGAIN_S = 30.0  # until a place that may be away is tried again where nothing is signed
_PATIENCE_S = 3.0  # a share that answers needs milliseconds


@dataclass(frozen=True, slots=True)
class Away:
    """The time since when the second place is not up to date, and the reason."""

    place: Path
    since_utc: str
    why: str


class KeptCopy(Protocol):
    """A copy that is stored in the second place."""

    @property
    def copy(self) -> Path:
        """The file there."""
        ...

    def bring_up_to_date(self) -> None:
        """Write there what is missing. Raises StoreError; the next call will add what is missing."""
        ...


class SecondPlace:
    """The copies of one data folder. Without `copies`, none is made, and nothing is ever away."""

    def __init__(self, copies: Sequence[KeptCopy], clock: Clock, *, patience_s: float = _PATIENCE_S) -> None:
        self._copies = tuple(copies)
        self._clock = clock
        self._patience_s = patience_s
        self._lock = Lock()
        self._away: Away | None = None
        self._busy = False
        self._again = False  # asked for while the thread was busy

    @classmethod
    def of(
        cls, data_dir: Path, copy: Path | None, clock: Clock, files: Files, *, patience_s: float = _PATIENCE_S
    ) -> Self:
        """Return the second place of a folder whose log of signatures is copied to `copy`, and its journal beside it.

        `copy` is None if it has no second place.
        """
        if copy is None:
            return cls((), clock, patience_s=patience_s)
        kept = LogCopy(data_dir / NAME, copy, files), JournalCopy(data_dir, journal_copy(copy), files)
        return cls(kept, clock, patience_s=patience_s)

    @property
    def away(self) -> Away | None:
        """The time since when the place is away, and why; None if it is up to date, as far as is known."""
        return self._away

    def update(self) -> Away | None:
        """Write there what is missing, and wait for it a little. Returns what is known then; raises nothing."""
        if not self._copies:
            return None
        with self._lock:
            if self._busy:
                self._again = True
                return self._away
            self._busy, self._again = True, False
        done = Event()  # by the host's clock: a file knows no other
        Thread(target=self._work, args=(done,), name="second place", daemon=True).start()
        if not done.wait(self._patience_s):
            with self._lock:
                if self._busy and not done.is_set():
                    self._tell(self._copies[0].copy, f"it has not answered for {self._patience_s:g} s")
        return self._away

    def look_after(self, ended: Signal) -> None:
        """Try again now and then until `ended` is set: the place may come back, or go away, while nobody signs."""
        while not ended.wait(AGAIN_S):
            self.update()

    def _work(self, done: Event) -> None:
        while True:
            failed = self._written()
            with self._lock:
                if failed is None:
                    self._away = None
                else:
                    self._tell(*failed)
                if not self._again:
                    self._busy = False
                    break
                self._again = False
        done.set()

    def _written(self) -> tuple[Path, str] | None:
        """Bring every copy up to date; return the one that failed and why, None if none did."""
        for one in self._copies:
            try:
                one.bring_up_to_date()
            except StoreError as error:
                return one.copy, error.what
            except (OSError, ValueError) as error:  # a path that no file can have
                return one.copy, str(error)
        return None

    def _tell(self, place: Path, why: str) -> None:
        since_utc = self._away.since_utc if self._away is not None else utc_text(self._clock.utc_now())
        self._away = Away(place, since_utc, why)


def away_words(away: Away) -> str:
    """Return the message about a second place that is away."""
    since = time_here(away.since_utc)
    return (
        f"the second place of the signatures, {away.place}, has not been up to date since {since}: {away.why}. "
        "It is tried again by itself, and what is missing will be written there"
    )


_FILES = DurableFiles()


class LogCopy:
    """A copy of a file of lines to which lines are only appended.

    What was compared is not read again, but for the last line of it.
    """

    def __init__(self, source: Path, copy: Path, files: Files = _FILES) -> None:
        self.source = source
        self.copy = copy
        self._files = files
        self._same = 0  # bytes at the beginning of both that are the same: whole lines
        self._last = b""  # the last of these lines

    def bring_up_to_date(self) -> None:
        """Append to the copy the lines that are missing from it. A copy with other content is left as it is.

        Raises:
            IntegrityError: the copy is not a beginning of the source: one of them was changed.
            StoreError: the copy cannot be written; the next call will add what is missing.
        """
        with copying_alone(self.source):
            self._update()

    def _update(self) -> None:
        start = self._same - len(self._last)
        ours, theirs = _bytes(self.source, start), _bytes(self.copy, start)
        if not (ours.startswith(self._last) and theirs.startswith(self._last)):
            start, self._same, self._last = 0, 0, b""
            ours, theirs = _bytes(self.source), _bytes(self.copy)
        ours, held = _whole_lines(ours), _whole_lines(theirs)
        if not ours.startswith(held):
            raise IntegrityError(
                "the copy of the log of signatures is not the beginning of the log: one of the two was changed",
                where=str(self.copy),
                remedy="Keep both; see `orthocapture audit verify --signatures`. Each data folder needs its own copy",
            )
        try:
            if not self.copy.exists():
                self._files.write(self.copy, ())
                self._files.sync_directory(self.copy.parent)
            if theirs != ours:
                self._files.append(self.copy, start + len(held), ours[len(held) :])  # over a partly written line
                self._files.sync_file(self.copy)
            elif not os.access(self.copy, os.W_OK):
                raise PermissionError(None, "it is read-only", str(self.copy))
        except OSError as error:
            raise StoreError(
                f"the copy of the log of signatures cannot be written: {error.strerror or error}",
                where=str(self.copy),
                remedy="Check that the share or the medium is there and that it has space",
            ) from error
        self._same = start + len(ours)
        self._last = ours[ours.rfind(b"\n", 0, -1) + 1 :]


def copy_faults(data_dir: Path, copy: Path) -> tuple[list[Fault], list[str]]:
    """Return faults and notes on differences between the log, or the journal, and its copy.

    Raises:
        StoreError: the copy is missing or cannot be read.
    """
    if not copy.exists():
        raise StoreError(
            "there is no such copy of the log of signatures", where=str(copy), remedy="Name the copy of this folder"
        )
    # The copy first: a signature made meanwhile is in the log before it is in the copy.
    held, log = (_whole_lines(_bytes(path)).splitlines(keepends=True) for path in (copy, data_dir / NAME))
    for number, line in enumerate(held, start=1):
        if number > len(log):
            what = f"{NAME} ends before line {number} of its copy: it was cut, and the record perhaps with it"
            return [Fault(None, None, str(copy), what)], []
        if log[number - 1] != line:
            return [Fault(None, None, f"{NAME}, line {number}", f"it is not the line that {copy} holds")], []
    missing = len(log) - len(held)
    notes = [f"{copy} does not have the last {missing} lines of {NAME} yet"] if missing else []
    return list(journal_copy_faults(data_dir, journal_copy(copy))), notes


def _whole_lines(content: bytes) -> bytes:
    return content[: content.rfind(b"\n") + 1]


def _bytes(path: Path, offset: int = 0) -> bytes:
    try:
        with path.open("rb") as stream:
            if offset:
                stream.seek(offset)
            return stream.read()
    except FileNotFoundError:
        return b""
    except OSError as error:
        raise unreadable(path, error) from error


_BLOCK_BYTES = 1 << 22


def journal_copy(signature_copy: Path) -> Path:
    """Return the path of the copy of the journal, from that of the copy of the log of signatures."""
    return signature_copy.with_name(f"{signature_copy.stem}.{JOURNAL_NAME}")


class JournalCopy:
    """The copy of the journal of a data folder; service.store.signatures.second_place.KeptCopy."""

    def __init__(self, data_dir: Path, copy: Path, files: Files) -> None:
        self._journal = data_dir / JOURNAL_NAME
        self.copy = copy
        self._files = files

    def bring_up_to_date(self) -> None:
        """Append to the copy the lines that are missing from it, once something was signed.

        Only its owner can read it, as it holds what the database holds. One process writes to it at a time: the lock
        is that of the log of signatures, as for its copy, because the journal's own would keep its writers waiting.

        Raises:
            IntegrityError: the copy is not a beginning of the journal: one of them was changed.
            StoreError: the copy cannot be written; the next call adds what is missing.
        """
        log = self._journal.with_name(NAME)
        with copying_alone(log):
            if not log.exists():
                return  # nothing was signed yet
            try:
                self._append()
            except OSError as error:
                raise StoreError(
                    f"the copy of the journal cannot be written: {error.strerror or error}",
                    where=str(self.copy),
                    remedy="Check that the share or the medium is there and that it has space",
                ) from error

    def _append(self) -> None:
        end, held = read_tail(self._journal), read_tail(self.copy)
        if end is None:
            return
        if held is not None and not _has(self._journal, held):
            raise IntegrityError(
                "the copy of the journal is not the beginning of the journal: one of the two was changed",
                where=str(self.copy),
                remedy="Keep both. If `orthocapture store rebuild` made the journal anew, rename this copy",
            )
        if not self.copy.exists():
            self._files.write(self.copy, (), private=True)
            self._files.sync_directory(self.copy.parent)
        begin = 0 if held is None else held.end
        with self._journal.open("rb") as stream:
            stream.seek(begin)
            while begin < end.end:
                block = stream.read(min(_BLOCK_BYTES, end.end - begin))
                self._files.append(self.copy, begin, block)  # overwrites a partly written line
                begin += len(block)
        self._files.sync_file(self.copy)


def journal_copy_faults(data_dir: Path, copy: Path) -> Iterator[Fault]:
    """Yield faults of the journal that its copy shows; none if there is no copy. Raises StoreError.

    Each line holds the hash of the one before it, so the copy's last line stands for all of them.
    """
    try:
        held, end = (
            read_tail(copy),
            read_tail(data_dir / JOURNAL_NAME),
        )  # the copy first: lines may be written meanwhile
        if held is None:
            return
        if end is None or end.number < held.number:
            cut = f"{JOURNAL_NAME} ends before line {held.number} of its copy"
            yield Fault(None, None, str(copy), f"{cut}: it was cut, and the record perhaps with it")
        elif not _has(data_dir / JOURNAL_NAME, held):
            yield Fault(None, None, f"{JOURNAL_NAME}, line {held.number}", f"it is not the line that {copy} holds")
    except OSError as error:
        raise StoreError(
            f"the journal cannot be compared with its copy: {error.strerror or error}",
            where=str(copy),
            remedy="Check that the share or the medium is there",
        ) from error


def _has(journal: Path, line: Tail) -> bool:
    """Return whether a journal has this line at the same place."""
    with journal.open("rb") as stream:
        stream.seek(line.start)
        return hashlib.sha256(stream.read(line.end - line.start)).hexdigest() == line.sha256
