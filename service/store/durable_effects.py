"""Interfaces for everything that must survive a crash (file writes, fsync, rename, commit), and for clock and ids."""

from __future__ import annotations

import os
import secrets
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path
from threading import Lock
from typing import Protocol

from service.core.records.base import Moment
from service.store.data_folder import file_mode, folder_mode, make_folder, open_new

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


class Files(Protocol):
    """The durable effects of the store: each is one call of this interface. All methods raise OSError.

    A crash may happen before, during or after any call; the order of the store's calls makes it harmless.
    """

    def make_directory(self, path: Path, *, private: bool = False) -> None:
        """Create one directory, unless it exists. Durable only after `sync_directory(path.parent)`.

        It is for whom the folder is in which it lies; a `private` one is for its owner alone.
        """
        ...

    def write(self, path: Path, chunks: Iterable[bytes], *, private: bool = False) -> None:
        """Create `path`, which must not exist, and write the chunks. Durable only after `sync_file`.

        It is for whom its folder is; a `private` one is never readable by others, not even for a moment.
        """
        ...

    def append(self, path: Path, offset: int, data: bytes) -> None:
        """Truncate a file, new or existing, to `offset` bytes and append data. Durable only after `sync_file`."""
        ...

    def make_read_only(self, path: Path) -> None:
        """Remove write permission."""
        ...

    def sync_file(self, path: Path) -> None:
        """Flush the file's data and metadata to disk."""
        ...

    def rename(self, source: Path, target: Path) -> None:
        """Rename atomically in one file system, replacing `target`. Durable only after `sync_directory`."""
        ...

    def sync_directory(self, path: Path) -> None:
        """Flush the directory's entries to disk."""
        ...

    def remove(self, path: Path) -> None:
        """Delete a file to which nothing refers, if it exists."""
        ...

    def commit(self, commit: Callable[[], None]) -> None:
        """Call `commit`, which commits one database transaction durably (WAL, synchronous=FULL)."""
        ...


class DurableFiles:
    """`Files` on a POSIX file system."""

    def make_directory(self, path: Path, *, private: bool = False) -> None:
        """Create one directory, unless it exists: for whom its folder is, a private one for its owner alone."""
        make_folder(path, 0o700 if private else folder_mode(path.parent))

    def write(self, path: Path, chunks: Iterable[bytes], *, private: bool = False) -> None:
        """Create a new file, for whom its folder is or private, and write the chunks. Raises OSError."""
        mode = 0o600 if private else file_mode(path.parent)
        with open(open_new(path, os.O_EXCL | os.O_WRONLY | os.O_NOFOLLOW, mode), "wb") as handle:
            for chunk in chunks:
                handle.write(chunk)

    def append(self, path: Path, offset: int, data: bytes) -> None:
        """Truncate a file (created if missing) to `offset` bytes and append the data. Raises OSError."""
        with open(open_new(path, os.O_WRONLY, file_mode(path.parent)), "wb") as handle:
            handle.truncate(offset)
            handle.seek(offset)
            handle.write(data)

    def make_read_only(self, path: Path) -> None:
        """Remove write permission. Raises OSError."""
        path.chmod(path.stat().st_mode & 0o444)

    def sync_file(self, path: Path) -> None:
        """Flush the file's data and metadata to disk with fsync. Raises OSError."""
        _sync(path, os.O_RDONLY)

    def rename(self, source: Path, target: Path) -> None:
        """Rename atomically within one file system, replacing `target`. Raises OSError."""
        source.replace(target)

    def sync_directory(self, path: Path) -> None:
        """Flush the directory's entries to disk with fsync. Raises OSError."""
        _sync(path, os.O_RDONLY | os.O_DIRECTORY)

    def remove(self, path: Path) -> None:
        """Delete a file, if it exists. Raises OSError."""
        path.unlink(missing_ok=True)

    def commit(self, commit: Callable[[], None]) -> None:
        """Call `commit`, which commits one database transaction durably."""
        commit()


def _sync(path: Path, flags: int) -> None:
    descriptor = os.open(path, flags | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class Signal(Protocol):
    """A signal that one thread sets and others wait for, as long as a clock says; a `threading.Event` is one."""

    def set(self) -> None:
        """Wake all that wait, and let nobody wait any more."""
        ...

    def is_set(self) -> bool:
        """Return whether it was set."""
        ...

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until it is set, or for `timeout` seconds of the clock; returns whether it is set."""
        ...


class Clock(Protocol):
    """The source of times, and of waits: whatever waits for a time to come waits on the clock that shows it."""

    def utc_now(self) -> datetime:
        """Return the present time in UTC, timezone-aware."""
        ...

    def utc_s(self) -> float:
        """Return the same in seconds since the epoch."""
        ...

    def monotonic_s(self) -> float:
        """Return the monotonic time of the host in seconds; all processes of one boot share its origin."""
        ...

    def boot(self) -> str:
        """Return the name of the host's present boot; "" if the system has none."""
        ...

    def sleep(self, seconds: float) -> None:
        """Return when so many seconds have passed."""
        ...

    def signal(self) -> Signal:
        """Return a new signal, on which threads wait by this clock."""
        ...


class SystemClock:
    """The host's clocks."""

    def utc_now(self) -> datetime:
        """Return the host's time in UTC, timezone-aware."""
        return datetime.now(UTC)

    def utc_s(self) -> float:
        """Return the host's time in seconds since the epoch."""
        return self.utc_now().timestamp()

    def monotonic_s(self) -> float:
        """Return the seconds of the host's monotonic clock."""
        return time.monotonic()

    def boot(self) -> str:
        """Return the boot id of the kernel, "" where it has none."""
        return _BOOT_ID.read_text().strip() if _BOOT_ID.exists() else ""

    def sleep(self, seconds: float) -> None:
        """Suspend this thread for so many seconds."""
        time.sleep(seconds)

    def signal(self) -> Signal:
        """Return a `threading.Event`."""
        return threading.Event()


def moment_of(clock: Clock) -> Moment:
    """Return the present moment in both clocks of the host."""
    return Moment(clock.monotonic_s(), utc_text(clock.utc_now()), clock.boot())


def utc_text(at: datetime) -> str:
    """Return an aware time as ISO 8601 text in UTC with microseconds and Z, as in events."""
    return at.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")


class IdSource(Protocol):
    """The source of names for runs, jobs and tokens; unique within the data folder."""

    def new_run(self, at: datetime) -> str:
        """Return a name for a run started at `at`; names sort by time."""
        ...

    def new_job(self) -> str:
        """Return a name for a job."""
        ...

    def new_token(self) -> str:
        """Return an unguessable token: proof of a lease, or name of a temporary file."""
        ...


class RandomIds:
    """Random names; that of a run begins with its date and time, so that people can find it."""

    def new_run(self, at: datetime) -> str:
        """Return a name such as 20260101-080000-a1b2c3, which sorts by time (UTC)."""
        return f"{at.astimezone(UTC):%Y%m%d-%H%M%S}-{secrets.token_hex(3)}"

    def new_job(self) -> str:
        """Return a name of `job-` and 16 random hexadecimal digits."""
        return f"job-{secrets.token_hex(8)}"

    def new_token(self) -> str:
        """Return an unguessable token of 32 hexadecimal digits."""
        return secrets.token_hex(16)


_KEPT = 10_000  # times that are remembered, the newest


class Ages:
    """How old a time in UTC is at least and at most.

    When this process first meets a time, it keeps its age by UTC. From then on the monotonic clock says how much
    older it has become, beside UTC. The host's clock may be set meanwhile, and the host may sleep; of the two ages
    the smaller says how long somebody has surely waited, the larger how old something may be. A new process begins
    with UTC, so that a restart of the host is bridged.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._met: OrderedDict[float, tuple[float, float]] = OrderedDict()  # time → its age then, monotonic time then
        self._lock = Lock()

    def begin(self, since_utc_s: float) -> None:
        """Meet a time that is being recorded, so that both clocks count from now on."""
        self._both(since_utc_s)

    def at_least_s(self, since_utc_s: float) -> float:
        """Return the age in seconds that has surely passed; negative before the time has come."""
        return min(self._both(since_utc_s))

    def at_most_s(self, since_utc_s: float) -> float:
        """Return the largest age in seconds that it may have; negative before the time has come."""
        return max(self._both(since_utc_s))

    def _both(self, since_utc_s: float) -> tuple[float, float]:
        """Return the age by UTC and that by the monotonic clock."""
        age_s, now_s = self._clock.utc_s() - since_utc_s, self._clock.monotonic_s()
        with self._lock:
            age_then_s, then_s = self._met.setdefault(since_utc_s, (age_s, now_s))
            self._met.move_to_end(since_utc_s)
            while len(self._met) > _KEPT:
                self._met.popitem(last=False)
        return age_s, age_then_s + now_s - then_s
