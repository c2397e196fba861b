"""Arrays that take seconds to compute, kept in a folder for the next process that would compute the same.

Off unless the environment names a folder. An entry's name is the hash of everything that its arrays depend on: the
given inputs to the last bit, the simulators' source, and the versions of the libraries. Any number of processes may
use one folder: entries appear whole, and the least recently used ones go when there are too many.
"""

from __future__ import annotations

import hashlib
import os
import platform
import threading
import zipfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from importlib import resources
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

VARIABLE = "ORTHOCAPTURE_RENDER_CACHE"
MOST_BYTES = 2**30
MOST_ENTRY_BYTES = MOST_BYTES // 4
_LIBRARIES = ("embreex", "numpy", "opencv-python-headless", "scipy")
_SOURCE = ("", "rendering/", "scan_station/", "scene/")  # of all that is kept
_SUFFIX = ".npz"
Arrays = Sequence[NDArray[Any]]


def cached(what: str, inputs: Sequence[object], compute: Callable[[], Arrays]) -> Arrays:
    """Return what `compute()` returns, or has returned for the same inputs before; the arrays are the same bits.

    Args:
        what: a word for what they are.
        inputs: all that they depend on besides the source: arrays, and values whose `repr` says all of them.
        compute: computes them.
    """
    folder = os.environ.get(VARIABLE)
    if not folder:
        return compute()
    path = Path(folder) / f"{what}-{_hash(what, *inputs)}{_SUFFIX}"
    found = _read(path)
    if found is None:
        found = compute()
        if sum(array.nbytes for array in found) <= MOST_ENTRY_BYTES:
            with suppress(OSError):  # a full disk, or a folder that cannot be written: it is computed again
                _write(path, found)
    return found


def _read(path: Path) -> Arrays | None:
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
            found = [arrays[name] for name in arrays.files]
        os.utime(path)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):  # there is none, or it is damaged
        return None
    return found


def _write(path: Path, arrays: Arrays) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(f".{os.getpid()}-{threading.get_ident()}.part")
    try:
        with part.open("wb") as stream:
            np.savez(stream, *arrays)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    _make_room(path.parent)


def _make_room(folder: Path) -> None:
    """Remove the least recently used files beyond MOST_BYTES, with what processes that died have left."""
    files: list[tuple[float, int, Path]] = []
    for path in folder.iterdir():
        with suppress(FileNotFoundError):  # another process removes files too
            status = path.stat()
            files.append((status.st_mtime, status.st_size, path))
    room = MOST_BYTES
    for _, size, path in sorted(files, reverse=True):
        room -= size
        if room < 0:
            path.unlink(missing_ok=True)


def _hash(*inputs: object) -> str:
    digest = hashlib.sha256(_of_the_program())
    for given in inputs:
        if isinstance(given, np.ndarray):
            array: NDArray[Any] = np.ascontiguousarray(given)
            digest.update(f"{array.dtype.str}{array.shape}".encode())
            digest.update(array.tobytes())
        else:
            digest.update(repr(given).encode())
        digest.update(b"\0")
    return digest.hexdigest()[:40]


@cache
def _of_the_program() -> bytes:
    """The hash of the simulators' source, and of the libraries and the machine that compute with it."""
    digest = hashlib.sha256()
    root = Path(str(resources.files("simulators")))
    for path in (path for folder in _SOURCE for path in sorted(root.glob(f"{folder}*.py"))):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    machine = (platform.machine(), platform.python_version(), *map(version, _LIBRARIES))
    digest.update(repr(machine).encode())
    return digest.digest()
