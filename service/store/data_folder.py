"""A data folder: what stands for it, who may read it, and whether SQLite is safe where it lies."""

from __future__ import annotations

import errno
import fcntl
import logging
import mmap
import os
import pwd
import re
import stat
import struct
import tempfile
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from service.core.errors import StoreError

if TYPE_CHECKING:
    from service.store.site import ObjectStoreSection, SiteFile

SITE_FILE = "site.yaml"


def data_folder(named: Path) -> Path:
    """Return the data folder that `--data` names: a folder, or the folder of a site.yaml."""
    return named.parent if named.name == SITE_FILE and not os.path.isdir(named) else named


def site_of(data_dir: Path) -> SiteFile | None:
    """Return what the site.yaml of a data folder says; None, and nothing is loaded, without one.

    Raises ConfigurationError.
    """
    if not (data_dir / SITE_FILE).is_file():
        return None
    from service.store.site import load_site  # noqa: PLC0415 - for sites only

    return load_site(data_dir)


def object_store_of(data_dir: Path) -> ObjectStoreSection | None:
    """Return the object store that a data folder's site.yaml names; None without one. Raises ConfigurationError."""
    site = site_of(data_dir)
    return None if site is None else site.object_store


# Who may read a data folder: the account that made it, or the group with which that account shares it on purpose.
#
# A folder with the set-group-ID bit that its group may write to (`chmod 2770`) is shared on purpose. Everything
# else is its owner's alone. Whatever is made within follows its folder; keys are always their owner's alone.


KEYS = "keys"  # the folder that is never shared
PEPPER = "pepper"  # within it, the key to which hashes of PINs and badges are bound
_FILES = "artefacts"  # the folder of the files
_log = logging.getLogger(__name__)
_SHARED_MODE = stat.S_ISGID | stat.S_IRWXG
_ACCESS_REMEDY = (
    "Run this as that account. To share the folder with a group, its owner gives `chgrp GROUP DIR` and "
    "`chmod 2770 DIR`, then any command of orthocapture that writes there; keys/ stays the owner's alone, so that "
    "only the owner signs"
)


def is_shared(folder: Path) -> bool:
    """Return whether a folder is shared with its group on purpose. Raises OSError."""
    return folder.stat().st_mode & _SHARED_MODE == _SHARED_MODE


def folder_mode(parent: Path) -> int:
    """Return the mode of a folder that is made within another: whoever may enter that one may enter it.

    Raises OSError.
    """
    mode = stat.S_IMODE(parent.stat().st_mode)
    return 0o700 | mode & (_SHARED_MODE if mode & _SHARED_MODE == _SHARED_MODE else 0) | mode & 0o055


def file_mode(folder: Path) -> int:
    """Return the mode of a file that is made within a folder: whoever may enter may read it. Raises OSError."""
    return folder_mode(folder) & 0o666


def make_folder(path: Path, mode: int) -> None:
    """Make a folder with exactly this mode, unless there is one. Raises OSError."""
    try:
        path.mkdir(mode=mode & 0o700)
    except FileExistsError:
        if not path.is_dir():
            raise
    else:
        with suppress(OSError):  # some file systems keep no rights; until here nobody else has any
            path.chmod(mode)


def open_new(path: Path, flags: int, mode: int) -> int:
    """Return the descriptor of a file that is made with exactly this mode unless it exists. Raises OSError."""
    try:
        descriptor = os.open(path, flags | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    except FileExistsError:
        if flags & os.O_EXCL:
            raise
        return os.open(path, flags | os.O_CLOEXEC)
    with suppress(OSError):
        os.fchmod(descriptor, mode)
    return descriptor


@contextmanager
def kept_to(folder: Path) -> Generator[None]:
    """Let this process and its children make nothing, meanwhile, that others than a folder's people may read."""
    before = os.umask(0o007 if folder.is_dir() and is_shared(folder) else 0o077)
    try:
        yield
    finally:
        os.umask(before)


def require_access(folder: Path) -> None:
    """Raise StoreError if the account of this process may not use a folder that exists."""
    try:
        closed = folder.is_dir() and not os.access(folder, os.R_OK | os.X_OK, effective_ids=True)
    except PermissionError:
        closed = True
    if closed:
        raise StoreError(
            f"this folder is only for the account {_owner(folder)}; this process runs as {_name(os.geteuid())}",
            where=str(folder),
            remedy=_ACCESS_REMEDY,
        )


def close_to_others(folder: Path, database: str) -> None:
    """Take a folder, perhaps of an earlier version, from everybody to whom it does not belong; the log says so.

    Where everything is as it should be, this looks at the folder and its database only. What another account owns is
    left as it is. Raises StoreError for a folder that belongs to everybody, such as /tmp.
    """
    before = folder.stat()
    if before.st_mode & stat.S_ISVTX:
        raise StoreError(
            "this folder is everybody's", where=str(folder), remedy="Name a folder within it, which need not exist"
        )
    shared = before.st_mode & _SHARED_MODE == _SHARED_MODE
    kept = _SHARED_MODE if shared else 0
    wanted = 0o700 | kept
    if before.st_uid != os.geteuid() or (
        stat.S_IMODE(before.st_mode) == wanted and not _differs(folder / database, kept, before.st_gid)
    ):
        return
    with suppress(OSError):
        folder.chmod(wanted)  # first of all: nobody else reaches what lies within any more
    if stat.S_IMODE(folder.stat().st_mode) != wanted:
        _log.warning("%s cannot be closed to other accounts of this machine: its file system keeps no rights", folder)
        return
    changed = sum(_close(path, kept, before.st_gid) for path in _within(folder))
    if changed:
        before_that = (
            ""
            if stat.S_IMODE(before.st_mode) == wanted
            else ("; until now other accounts of this machine could read it, the hashes of PINs included")
        )
        whose = f"its owner and the group {before.st_gid}" if shared else "its owner"
        _log.warning("%s and what it holds are for %s alone now%s", folder, whose, before_that)


def _differs(database: Path, kept: int, group: int) -> bool:
    """Return whether a database, or where there is none the folder of the files, is shared otherwise than wanted."""
    entered = 0o060
    try:
        held = database.stat()
    except FileNotFoundError:
        entered = 0o070
        try:
            held = database.with_name(_FILES).stat()
        except FileNotFoundError:
            return False
    rights = (held.st_mode & 0o077, held.st_gid)
    return rights != (kept & entered, group if kept else held.st_gid)


def _within(folder: Path) -> Iterator[Path]:
    for root, folders, files in os.walk(folder):
        yield from (Path(root, name) for name in (*folders, *files))


def _close(path: Path, kept: int, group: int) -> bool:
    """Close one folder or file, and return whether anything changed."""
    with suppress(OSError):
        now = path.lstat()
        if not (stat.S_ISREG(now.st_mode) or stat.S_ISDIR(now.st_mode)) or now.st_uid != os.geteuid():
            return False
        mode = stat.S_IMODE(now.st_mode)
        wanted = mode & 0o700
        if kept and KEYS not in (path.name, path.parent.name):
            if now.st_gid != group:
                os.chown(path, -1, group)
            wanted |= wanted >> 3 & 0o070 | (stat.S_ISGID if stat.S_ISDIR(now.st_mode) else 0)
        if wanted != mode:
            path.chmod(wanted)
            return True
    return False


def _owner(folder: Path) -> str:
    try:
        return _name(folder.stat().st_uid)
    except OSError:
        return "that owns a folder above it"


def _name(uid: int) -> str:
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


# Whether a data folder lies where SQLite in WAL mode is safe: on a file system of this machine alone, with locks.
#
# SQLite's log needs locks that every process sees and memory that all of them share. A file system that other
# machines mount too (NFS, SMB and their like) has the first only sometimes and the second never: two machines that
# write lose data without an error (sqlite.org/wal.html, "Overview").


#: Set in the environment, this allows any mount for this program and all that it starts.
ALLOW = "ORTHOCAPTURE_ALLOW_MOUNT"
MOUNT_TABLE = Path("/proc/self/mountinfo")
# File systems that several machines mount at once. Those of containers and of encrypted disks are not among them.
_SHARED_FILE_SYSTEMS = frozenset({
    "nfs", "nfs4", "cifs", "smb3", "smbfs", "ncpfs", "afs", "coda", "ceph", "lustre", "glusterfs", "beegfs", "gfs2",
    "ocfs2", "gpfs", "orangefs", "pvfs2", "davfs", "vboxsf", "prl_fs", "drvfs",
    "fuse.sshfs", "fuse.s3fs", "fuse.rclone", "fuse.glusterfs", "fuse.ceph", "fuse.davfs2", "fuse.gcsfuse",
    "fuse.goofys", "fuse.juicefs", "fuse.seaweedfs", "fuse.moosefs", "fuse.smbnetfs", "fuse.vmhgfs-fuse",
})  # fmt: skip
_NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS, errno.ENODEV)
_MOUNT_REMEDY = (
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
            remedy=_MOUNT_REMEDY,
        )


def why_unsafe(folder: Path) -> str:
    """Return why a database in a folder would lose data, to follow "the data folder is"; "" if it would not."""
    return _find(folder.resolve(), folder.stat().st_dev)


@lru_cache(maxsize=64)  # once for each folder of a device
def _find(folder: Path, _device: int) -> str:
    kind = file_system(folder)
    if kind in _SHARED_FILE_SYSTEMS:
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
