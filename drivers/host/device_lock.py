"""A lock for each device: only one process of this machine drives it, whatever data folder or rig file names it."""

from __future__ import annotations

import fcntl
import hashlib
import os
import tempfile
from pathlib import Path
from typing import Self

from drivers.errors import DeviceUnavailableError

_PLACES = (Path("/run/lock"), Path(tempfile.gettempdir()))
_NETWORK = Path("/proc/self/ns/net")


class DeviceLock:
    """Exclusive access to a device. The operating system releases it when the process ends, however it ends."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    @classmethod
    def take(cls, address: str, name: str) -> Self:
        """Acquire the lock of a device, without waiting.

        Args:
            address: identifies the device uniquely: its driver and where it is connected.
            name: the device's name in the rig file, for messages.

        Raises:
            DeviceUnavailableError: another process holds the lock.
        """
        path = _folder() / f"{hashlib.sha256(f'{_network()} {address}'.encode()).hexdigest()[:32]}.lock"
        descriptor = _open(path)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = os.pread(descriptor, 100, 0).decode(errors="replace").strip() or "unknown"
            os.close(descriptor)
            raise DeviceUnavailableError(
                f"another process drives this device ({address}): process {holder}",
                where=name,
                remedy="End the run or the command that uses it; see `orthocapture status`",
            ) from error
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
        return cls(descriptor)

    def release(self) -> None:
        """Release the lock; a second call has no effect."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def _folder() -> Path:
    place = next((place for place in _PLACES if place.is_dir() and os.access(place, os.W_OK)), _PLACES[-1])
    folder = place / "orthocapture"
    folder.mkdir(exist_ok=True)
    if folder.stat().st_uid == os.getuid():
        folder.chmod(0o1777)  # writable for every user of the machine
    return folder


def _open(path: Path) -> int:
    """Open the lock file, creating it for all users of the machine if needed; returns its descriptor.

    The file is never deleted: a process that had opened the deleted file would hold a lock of its own.
    """
    flags = os.O_RDWR | os.O_CLOEXEC
    try:
        descriptor = os.open(path, flags | os.O_CREAT | os.O_EXCL)
    except FileExistsError:
        return os.open(path, flags)  # Linux refuses O_CREAT for another user's file in a sticky folder
    os.fchmod(descriptor, 0o666)
    return descriptor


def _network() -> str:
    """The identity of this process's network namespace; the same address elsewhere is another device."""
    return os.readlink(_NETWORK) if _NETWORK.exists() else ""
