"""A failing disk and database and a jumping clock, injected through the store's file operations."""

from __future__ import annotations

import errno
import os
import sqlite3
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path

from sqlalchemy.exc import OperationalError

from service.store.durable_effects import DurableFiles, SystemClock

# SQLite's messages for system errors, as for its codes SQLITE_FULL, SQLITE_READONLY, SQLITE_IOERR.
_SQLITE = {
    errno.ENOSPC: ("SQLITE_FULL", "database or disk is full"),
    errno.EROFS: ("SQLITE_READONLY", "attempt to write a readonly database"),
}


@dataclass
class FaultyDisk:
    """service.store.durable_effects.Files on a disk that fails from one call on, until somebody repairs it.

    Attributes:
        effect: the kind of call that fails; empty: all kinds.
        nth: the first failing call, from 1, counted from when the fault is armed.
        number: errno of the system's error.
        file: the name of the file for which alone calls fail; empty: all files.
    """

    effect: str
    nth: int
    number: int
    file: str = ""
    armed: bool = False
    failed: int = 0
    mended: bool = False
    calls: dict[str, int] = field(default_factory=dict[str, int])
    _real: DurableFiles = field(default_factory=DurableFiles)

    def make_directory(self, path: Path, *, private: bool = False) -> None:
        """Create a directory. Raises OSError while the disk fails."""
        self._check("make_directory", path)
        self._real.make_directory(path, private=private)

    def write(self, path: Path, chunks: Iterable[bytes], *, private: bool = False) -> None:
        """Write a file. A full disk still takes the beginning of it. Raises OSError while the disk fails."""
        try:
            self._check("write", path)
        except OSError:
            if self.number == errno.ENOSPC:
                data = b"".join(chunks)
                self._real.write(path, [data[: len(data) // 2]], private=private)
            raise
        self._real.write(path, chunks, private=private)

    def append(self, path: Path, offset: int, data: bytes) -> None:
        """Append to a file. Raises OSError while the disk fails."""
        try:
            self._check("append", path)
        except OSError:
            if self.number == errno.ENOSPC:
                self._real.append(path, offset, data[: len(data) // 2])
            raise
        self._real.append(path, offset, data)

    def make_read_only(self, path: Path) -> None:
        """Make a file read-only. Raises OSError while the disk fails."""
        self._check("make_read_only", path)
        self._real.make_read_only(path)

    def sync_file(self, path: Path) -> None:
        """Sync a file. Raises OSError while the disk fails."""
        self._check("sync_file", path)
        self._real.sync_file(path)

    def rename(self, source: Path, target: Path) -> None:
        """Rename a file. Raises OSError while the disk fails."""
        self._check("rename", target)
        self._real.rename(source, target)

    def sync_directory(self, path: Path) -> None:
        """Sync a directory. Raises OSError while the disk fails."""
        self._check("sync_directory", path)
        self._real.sync_directory(path)

    def remove(self, path: Path) -> None:
        """Remove a file, which also a full disk can do. Raises OSError while the disk fails otherwise."""
        if self.number != errno.ENOSPC:
            self._check("remove", path)
        self._real.remove(path)

    def commit(self, commit: Callable[[], None]) -> None:
        """Commit. Raises SQLite's error for the system error while the disk fails."""
        try:
            self._check("commit", Path())
        except OSError as error:
            name, words = _SQLITE.get(self.number, ("SQLITE_IOERR", "disk I/O error"))
            plain = sqlite3.OperationalError(words)
            plain.sqlite_errorname = name
            raise OperationalError("COMMIT", None, plain) from error
        commit()

    def _check(self, effect: str, path: Path) -> None:
        if not self.armed or self.mended or self.effect not in ("", effect) or self.file not in ("", path.name):
            return
        self.calls[effect] = self.calls.get(effect, 0) + 1
        if sum(self.calls.values()) >= self.nth:
            self.failed += 1
            raise OSError(self.number, os.strerror(self.number), str(path))


@dataclass
class JumpingClock(SystemClock):
    """A clock whose UTC can be set by somebody, while its monotonic time continues."""

    ahead_s: float = 0.0

    def utc_now(self) -> datetime:
        """The UTC time with the current offset."""
        return datetime.now(UTC) + timedelta(seconds=self.ahead_s)
