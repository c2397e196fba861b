"""Who may read a data folder: the account that made it, or the group with which that account shares it on purpose.

A folder with the set-group-ID bit that its group may write to (`chmod 2770`) is shared on purpose. Everything else is
its owner's alone. Whatever is made within follows its folder; keys are always their owner's alone.
"""

from __future__ import annotations

import logging
import os
import pwd
import stat
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from service.core.errors import StoreError

KEYS = "keys"  # the folder that is never shared
PEPPER = "pepper"  # within it, the key to which hashes of PINs and badges are bound
_FILES = "artefacts"  # the folder of the files
_LOG = logging.getLogger(__name__)
_SHARED = stat.S_ISGID | stat.S_IRWXG
_REMEDY = (
    "Run this as that account. To share the folder with a group, its owner gives `chgrp GROUP DIR` and "
    "`chmod 2770 DIR`, then any command of orthocapture that writes there; keys/ stays the owner's alone, so that "
    "only the owner signs"
)


def is_shared(folder: Path) -> bool:
    """Return whether a folder is shared with its group on purpose. Raises OSError."""
    return folder.stat().st_mode & _SHARED == _SHARED


def folder_mode(parent: Path) -> int:
    """Return the mode of a folder that is made within another: whoever may enter that one may enter it.

    Raises OSError.
    """
    mode = stat.S_IMODE(parent.stat().st_mode)
    return 0o700 | mode & (_SHARED if mode & _SHARED == _SHARED else 0) | mode & 0o055


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
            remedy=_REMEDY,
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
    shared = before.st_mode & _SHARED == _SHARED
    kept = _SHARED if shared else 0
    wanted = 0o700 | kept
    if before.st_uid != os.geteuid() or (
        stat.S_IMODE(before.st_mode) == wanted and not _differs(folder / database, kept, before.st_gid)
    ):
        return
    with suppress(OSError):
        folder.chmod(wanted)  # first of all: nobody else reaches what lies within any more
    if stat.S_IMODE(folder.stat().st_mode) != wanted:
        _LOG.warning("%s cannot be closed to other accounts of this machine: its file system keeps no rights", folder)
        return
    changed = sum(_close(path, kept, before.st_gid) for path in _within(folder))
    if changed:
        before_that = (
            ""
            if stat.S_IMODE(before.st_mode) == wanted
            else ("; until now other accounts of this machine could read it, the hashes of PINs included")
        )
        whose = f"its owner and the group {before.st_gid}" if shared else "its owner"
        _LOG.warning("%s and what it holds are for %s alone now%s", folder, whose, before_that)


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
