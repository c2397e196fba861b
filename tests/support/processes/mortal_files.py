"""File operations that die by SIGKILL at a chosen point, and keep a journal of what has been synced."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from service.store.database.engine import database_path
from service.store.durable_effects import DurableFiles

Where = Literal["before", "within", "after"]
HALVED = ("write", "append")  # effects that a crash can leave half done
TORN = "commit"  # the effect that a loss of power can leave half done


@dataclass(frozen=True, slots=True)
class Point:
    """A point at which a process may die: a call of the file operations, counted from 0, and the place within it."""

    call: int
    effect: str
    where: Where


def points(journal: Path, *, power: bool) -> list[Point]:
    """All points of an undisturbed run; with `power` also those within a commit."""
    found: list[Point] = []
    for line in read_journal(journal):
        if line["where"] == "before":
            effect = str(line["effect"])
            found.append(Point(line["call"], effect, "before"))
            if effect in HALVED or (power and effect == TORN):
                found.append(Point(line["call"], effect, "within"))
            found.append(Point(line["call"], effect, "after"))
    return found


def read_journal(journal: Path) -> list[dict[str, Any]]:
    """Read the lines of a journal; the last one may be truncated by a SIGKILL."""
    if not journal.exists():
        return []
    content = journal.read_bytes()
    return [json.loads(line) for line in content[: content.rfind(b"\n") + 1].splitlines()]


class MortalFiles:
    """DurableFiles that records every effect in a journal and dies at one point of one of them."""

    def __init__(self, data: Path, journal: Path, die_at: Point | None) -> None:
        self._data = data
        self._journal = journal
        self._die_at = die_at
        self._attic = journal.with_suffix(".attic")
        self._real = DurableFiles()
        self._calls = 0
        self._lock = threading.Lock()
        self._out = os.open(journal, os.O_CREAT | os.O_APPEND | os.O_WRONLY | os.O_CLOEXEC)

    def make_directory(self, path: Path, *, private: bool = False) -> None:
        """Create a directory, with journal."""
        self._effect(
            "make_directory",
            lambda: self._real.make_directory(path, private=private),
            path=str(path),
            new=not path.exists(),
        )

    def write(self, path: Path, chunks: Iterable[bytes], *, private: bool = False) -> None:
        """Write a new file, with journal; can die half-way."""

        def half() -> None:
            data = b"".join(chunks)
            self._real.write(path, [data[: len(data) // 2]], private=private)

        self._effect("write", lambda: self._real.write(path, chunks, private=private), half, path=str(path))

    def append(self, path: Path, offset: int, data: bytes) -> None:
        """Append to a file at an offset, with journal; can die half-way."""
        self._effect(
            "append",
            lambda: self._real.append(path, offset, data),
            lambda: self._real.append(path, offset, data[: len(data) // 2]),
            path=str(path),
            offset=offset,
        )

    def make_read_only(self, path: Path) -> None:
        """Make a file read-only, with journal."""
        self._effect("make_read_only", lambda: self._real.make_read_only(path), path=str(path))

    def sync_file(self, path: Path) -> None:
        """Sync a file, with journal."""
        self._effect("sync_file", lambda: self._real.sync_file(path), path=str(path))

    def rename(self, source: Path, target: Path) -> None:
        """Rename a file, with journal."""
        self._effect("rename", lambda: self._real.rename(source, target), path=str(target), source=str(source))

    def sync_directory(self, path: Path) -> None:
        """Sync a directory, with journal."""
        self._effect("sync_directory", lambda: self._real.sync_directory(path), path=str(path))

    def remove(self, path: Path) -> None:
        """Remove a file, keeping a copy: until the folder is synced, a loss of power may bring it back."""
        aside = self._attic / f"{os.getpid()}-{self._calls}"  # a process that resumes also uses this journal
        if path.exists():
            self._attic.mkdir(exist_ok=True)
            os.link(path, aside)
        self._effect("remove", lambda: self._real.remove(path), path=str(path), aside=str(aside))

    def commit(self, commit: Callable[[], None]) -> None:
        """Commit, and record how far the chains had come when the commit returned."""

        def torn() -> None:
            before, unchanged = self._log_bytes(), self._checkpointed()
            commit()
            if self._checkpointed() == unchanged:  # otherwise SQLite has checkpointed its log meanwhile
                self._note({"torn": [before, end_of_commit(Path(f"{database_path(self._data)}-wal"), before)]})

        self._effect("commit", commit, torn)

    def _effect(
        self, effect: str, act: Callable[[], None], within: Callable[[], None] | None = None, **details: Any
    ) -> None:
        with self._lock:
            call, self._calls = self._calls, self._calls + 1
        line = {"call": call, "effect": effect, **details}
        self._note({**line, "where": "before"})
        self._die_here(call, effect, "before")
        if within is not None and self._is_here(call, "within"):
            within()
            self._die_here(call, effect, "within")
        act()
        if effect == TORN:
            line["events"] = events_recorded(self._data)
        self._note({**line, "where": "after"})
        self._die_here(call, effect, "after")

    def _is_here(self, call: int, where: Where) -> bool:
        return self._die_at is not None and (self._die_at.call, self._die_at.where) == (call, where)

    def _die_here(self, call: int, effect: str, where: Where) -> None:
        if self._is_here(call, where):
            self._note({"died": True, "call": call, "effect": effect, "where": "died", "at": where})
            os.kill(os.getpid(), signal.SIGKILL)

    def _note(self, line: dict[str, Any]) -> None:
        line = {"at_ns": time.monotonic_ns(), "where": "", **line}
        os.write(self._out, json.dumps(line).encode() + b"\n")

    def _log_bytes(self) -> int:
        log = Path(f"{database_path(self._data)}-wal")
        return log.stat().st_size if log.exists() else 0

    def _checkpointed(self) -> int:
        return database_path(self._data).stat().st_mtime_ns


def end_of_commit(log: Path, start: int) -> int:
    """Find the end of the first commit after `start` in a write-ahead log, to which others may have appended since.

    https://www.sqlite.org/fileformat2.html#the_write_ahead_log: a frame is a header of 24 bytes and a page; the
    second word of the header is non-zero in the last frame of a commit.
    """
    content = log.read_bytes() if log.exists() else b""
    if len(content) < 32:
        return len(content)
    frame = 24 + int.from_bytes(content[8:12], "big")
    for at in range(max(start, 32), len(content) - frame + 1, frame):
        if any(content[at + 4 : at + 8]):
            return at + frame
    return len(content)


def events_recorded(data: Path) -> int:
    """The number of events in all chains of a data folder; 0 if the tables do not exist yet."""
    with closing(sqlite3.connect(database_path(data), timeout=30)) as connection:
        try:
            return int(connection.execute("SELECT coalesce(sum(seq), 0) FROM heads").fetchone()[0])
        except sqlite3.OperationalError as error:
            if "no such table" in str(error):
                return 0
            raise
