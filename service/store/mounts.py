"""Whether a data folder lies where SQLite in WAL mode is safe: on a file system of this machine alone, with locks.

SQLite's log needs locks that every process sees and memory that all of them share. A file system that other machines
mount too (NFS, SMB and their like) has the first only sometimes and the second never: two machines that write lose
data without an error (sqlite.org/wal.html, "Overview").
"""

from __future__ import annotations

import errno
import fcntl
import mmap
import os
import re
import struct
import tempfile
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

from service.core.errors import StoreError

#: Set in the environment, this allows any mount for this program and all that it starts.
ALLOW = "ORTHOCAPTURE_ALLOW_MOUNT"
MOUNT_TABLE = Path("/proc/self/mountinfo")
# File systems that several machines mount at once. Those of containers and of encrypted disks are not among them.
_SHARED = frozenset({
    "nfs", "nfs4", "cifs", "smb3", "smbfs", "ncpfs", "afs", "coda", "ceph", "lustre", "glusterfs", "beegfs", "gfs2",
    "ocfs2", "gpfs", "orangefs", "pvfs2", "davfs", "vboxsf", "prl_fs", "drvfs",
    "fuse.sshfs", "fuse.s3fs", "fuse.rclone", "fuse.glusterfs", "fuse.ceph", "fuse.davfs2", "fuse.gcsfuse",
    "fuse.goofys", "fuse.juicefs", "fuse.seaweedfs", "fuse.moosefs", "fuse.smbnetfs", "fuse.vmhgfs-fuse",
})  # fmt: skip
_NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS, errno.ENODEV)
_REMEDY = (
    "Keep the data folder on a disk of the machine that writes it, and let other machines reach it through "
    "`orthocapture serve`; backups may go anywhere (`orthocapture store backup`). Who knows that only this machine "
    "ever opens the folder, and that its locks work, puts --allow-mount between `orthocapture` and the command"
)


def require_own_mount(folder: Path) -> None:
    """Refuse a data folder that lies where a database would lose data.

    Raises:
        StoreError: the file system is shared between machines, or it has no working locks.
    """
    if not os.environ.get(ALLOW) and (why := why_unsafe(folder)):
        raise StoreError(
            f"the data folder is {why}: a database in it loses data when two machines write",
            where=str(folder),
            remedy=_REMEDY,
        )


def why_unsafe(folder: Path) -> str:
    """Return why a database in a folder would lose data, to follow "the data folder is"; "" if it would not."""
    return _find(folder.resolve(), folder.stat().st_dev)


@lru_cache(maxsize=64)  # once for each folder of a device
def _find(folder: Path, _device: int) -> str:
    kind = file_system(folder)
    if kind in _SHARED:
        return f"on a file system that other machines can mount too ({kind})"
    return _why_no_locks(folder)


def file_system(folder: Path) -> str:
    """Return the type of the file system in which an absolute path lies; "" on systems without a table of mounts."""
    found, longest = "", -1
    with suppress(OSError):
        for line in MOUNT_TABLE.read_text(encoding="utf-8", errors="surrogateescape").splitlines():
            before, _, after = line.partition(" - ")
            point = Path(re.sub(r"\\(\d{3})", lambda octal: chr(int(octal[1], 8)), before.split()[4]))
            # Of several at one place, the last is in use.
            if folder.is_relative_to(point) and len(point.parts) >= longest:
                found, longest = after.split()[0], len(point.parts)
    return found


def _why_no_locks(folder: Path) -> str:
    """Return a text on what fails of locks and shared memory when tried; "" if nothing does."""
    try:
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".probe-") as one, Path(one.name).open("r+b") as other:
            _lock(one.fileno())
            if _locked(other.fileno()):
                one.truncate(mmap.PAGESIZE)
                with mmap.mmap(one.fileno(), mmap.PAGESIZE) as a, mmap.mmap(other.fileno(), mmap.PAGESIZE) as b:
                    a[:5] = b"there"
                    return "" if b[:5] == b"there" else "on a file system that does not share the memory of its files"
    except OSError as error:
        if error.errno in _NO_LOCKS:
            return f"on a file system without working locks ({os.strerror(error.errno)})"
        return ""  # a folder that cannot be written, or a full disk, is told where it is written
    return "on a file system whose locks do not exclude anybody"


# A write lock of the whole file that belongs to the opening rather than to the process, so that one process can tell
# whether it excludes another opening: struct flock of <fcntl.h>.
_WHOLE_FILE = struct.pack("hhqqi4x", fcntl.F_WRLCK, os.SEEK_SET, 0, 0, 0)
_SET_LOCK = getattr(fcntl, "F_OFD_SETLK", None)


def _lock(descriptor: int) -> None:
    if _SET_LOCK is None:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    else:
        fcntl.fcntl(descriptor, _SET_LOCK, _WHOLE_FILE)


def _locked(descriptor: int) -> bool:
    """Return whether another opening of the file holds the lock."""
    try:
        _lock(descriptor)
    except (BlockingIOError, PermissionError):
        return True
    return False
