"""The one seam for everything that must survive a crash: file writes, fsync, rename, commit; and clock and ids."""

from __future__ import annotations

import os
import secrets
import time
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Protocol


class Files(Protocol):
    """Every durable effect of the store is one call of this. All methods raise OSError, as the system does.

    A crash may fall before, within or after any call; the store's order of calls makes each of them harmless.
    """

    def make_directory(self, path: Path, *, private: bool = False) -> None:
        """Create one directory; an existing one is fine. Not durable before `sync_directory(path.parent)`."""
        ...

    def write(self, path: Path, chunks: Iterable[bytes], *, private: bool = False) -> None:
        """Create `path`, which must not exist, and write the chunks. Not durable before `sync_file`.

        What is `private` nobody else can read, not even for a moment.
        """
        ...

    def append(self, path: Path, offset: int, data: bytes) -> None:
        """Cut a file, or begin a new one, to `offset` bytes and add the data. Not durable before `sync_file`."""
        ...

    def make_read_only(self, path: Path) -> None:
        """Take away write permission (0o444)."""
        ...

    def sync_file(self, path: Path) -> None:
        """Data and metadata of the file reach the disk."""
        ...

    def rename(self, source: Path, target: Path) -> None:
        """Atomic within one file system, replaces. Not durable before `sync_directory(target.parent)`."""
        ...

    def sync_directory(self, path: Path) -> None:
        """The names in the directory reach the disk."""
        ...

    def remove(self, path: Path) -> None:
        """Delete a file to which nothing refers; a missing one is fine."""
        ...

    def commit(self, commit: Callable[[], None]) -> None:
        """Call `commit`, which commits one database transaction durably (WAL, synchronous=FULL)."""
        ...


class DurableFiles:
    """The seam on a POSIX file system."""

    def make_directory(self, path: Path, *, private: bool = False) -> None:
        """See Files."""
        path.mkdir(mode=0o700 if private else 0o777, exist_ok=True)

    def write(self, path: Path, chunks: Iterable[bytes], *, private: bool = False) -> None:
        """See Files."""
        flags = os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC | os.O_NOFOLLOW
        with open(os.open(path, flags, 0o600 if private else 0o666), "wb") as handle:
            for chunk in chunks:
                handle.write(chunk)

    def append(self, path: Path, offset: int, data: bytes) -> None:
        """See Files."""
        with open(os.open(path, os.O_CREAT | os.O_WRONLY | os.O_CLOEXEC, 0o666), "wb") as handle:
            handle.truncate(offset)
            handle.seek(offset)
            handle.write(data)

    def make_read_only(self, path: Path) -> None:
        """See Files."""
        path.chmod(0o444)

    def sync_file(self, path: Path) -> None:
        """See Files."""
        _sync(path, os.O_RDONLY)

    def rename(self, source: Path, target: Path) -> None:
        """See Files."""
        source.replace(target)

    def sync_directory(self, path: Path) -> None:
        """See Files."""
        _sync(path, os.O_RDONLY | os.O_DIRECTORY)

    def remove(self, path: Path) -> None:
        """See Files."""
        path.unlink(missing_ok=True)

    def commit(self, commit: Callable[[], None]) -> None:
        """See Files."""
        commit()


def _sync(path: Path, flags: int) -> None:
    descriptor = os.open(path, flags | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class Clock(Protocol):
    """Where times come from."""

    def utc_now(self) -> datetime:
        """Aware, UTC."""
        ...

    def monotonic_s(self) -> float:
        """Host monotonic time, the same origin in all processes of one boot."""
        ...


class SystemClock:
    """The host's clocks."""

    def utc_now(self) -> datetime:
        """See Clock."""
        return datetime.now(UTC)

    def monotonic_s(self) -> float:
        """See Clock."""
        return time.monotonic()


def utc_text(at: datetime) -> str:
    """ISO 8601 with microseconds and Z, as events carry it."""
    return at.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")


class Ids(Protocol):
    """Where names of new things come from; unique in the data folder."""

    def new_run(self, at: datetime) -> str:
        """Sorts by time."""
        ...

    def new_job(self) -> str:
        """Name of a job."""
        ...

    def new_token(self) -> str:
        """Unguessable: proof of a lease, and name of a temporary file."""
        ...


class RandomIds:
    """Random names; a run's begins with its date and time so that people can find it."""

    def new_run(self, at: datetime) -> str:
        """See Ids."""
        return f"{at.astimezone(UTC):%Y%m%d-%H%M%S}-{secrets.token_hex(3)}"

    def new_job(self) -> str:
        """See Ids."""
        return f"job-{secrets.token_hex(8)}"

    def new_token(self) -> str:
        """See Ids."""
        return secrets.token_hex(16)
