"""One task of a job on another machine: what it needs there is checked before it is computed."""

from __future__ import annotations

import hashlib
import importlib
import io
import pickle
import platform
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import numpy as np

from service.core.errors import ConfigurationError, DataError
from service.core.units import megabytes
from service.machine.executors import Place, this_place
from service.machine.resources import keep_freed_memory

_DECIDES = ("compute", "core", "dataset", "machine")  # the rooms of the service whose source decides a task's result
_LARGEST_BYTES = 1_000_000  # of a task's arguments: larger ones belong into a file


@dataclass(frozen=True, slots=True)
class NeededFile:
    """A file that a task reads, with its size as the job sees it; -1 for a folder that it writes into.

    `sha256` is the hash of its content where its name says that, as of all artefacts; "" otherwise.
    """

    path: str
    size_bytes: int
    sha256: str = ""


@dataclass(frozen=True, slots=True)
class RemoteTask:
    """A call, pickled, with the files that it needs and the versions of the program that asks for it."""

    call: bytes
    files: tuple[NeededFile, ...]
    versions: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class RemoteResult:
    """The value that a task returned, and the place where it was computed."""

    value: Any
    place: Place


def remote_task(call: Callable[[], Any]) -> RemoteTask:
    """Return the task of a call.

    Raises ConfigurationError if it holds arrays that are too large to travel, and TypeError or AttributeError if it
    cannot be pickled.
    """
    written = io.BytesIO()
    pickler = _CallPickler(written, protocol=pickle.HIGHEST_PROTOCOL)
    pickler.dump(call)
    data = written.getvalue()
    if len(data) > _LARGEST_BYTES:
        raise ConfigurationError(
            f"the arguments of one task have {megabytes(len(data)):.1f} MB",
            remedy="Pass the path of a file",
        )
    return RemoteTask(data, tuple(_needed(path) for path in pickler.paths), tuple(versions_here().items()))


def compute_there(task: RemoteTask) -> RemoteResult:
    """Compute a task on the machine that it was sent to.

    Raises:
        ConfigurationError: this machine has other versions than the one that asks.
        DataError: this machine does not see a file, or sees another one under its path.
    """
    place = this_place()
    differing = different_versions(dict(task.versions), versions_here())
    if differing:
        raise version_error(place.host, differing)
    here = {needed.path: _path_here(needed, place.host) for needed in task.files}
    _prepare_process()
    importlib.import_module("cv2").setNumThreads(1)  # as in the processes of the job's own machine
    call: Callable[[], Any] = _CallUnpickler(io.BytesIO(task.call), here).load()
    return RemoteResult(call(), place)


@cache
def _prepare_process() -> None:
    """Let this process hold freed memory as a worker does: Dask has it returned at once, which costs much time."""
    keep_freed_memory()


@cache
def versions_here() -> Mapping[str, str]:
    """Return the versions on which a task's result depends; that of orthocapture with a hash of its source."""
    return {
        "Python": platform.python_version(),
        "numpy": np.__version__,
        "opencv": str(importlib.import_module("cv2").__version__),
        "orthocapture": f"{_installed('orthocapture')}, source {_source()}",
    }


def different_versions(wanted: Mapping[str, str], there: Mapping[str, str]) -> str:
    """Say which versions differ; "" if none does."""
    return "; ".join(
        f"{name} {there.get(name) or 'missing'} instead of {own}"
        for name, own in wanted.items()
        if there.get(name) != own
    )


def version_error(host: str, differing: str) -> ConfigurationError:
    """Return the refusal of a machine whose versions differ."""
    return ConfigurationError(
        f"the machine {host} of the cluster has {differing}",
        where=host,
        remedy="Install the same version of orthocapture there, with the same locked packages and Python, and start "
        "its Dask worker again",
    )


def _installed(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "not installed"


def _source() -> str:
    """Return a hash of the code that decides what a task computes."""
    service = files("service")
    digest = hashlib.sha256()
    for room in _DECIDES:
        for name, file in sorted(_sources(service / room, room)):
            digest.update(name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:12]


def _sources(folder: Traversable, name: str) -> Iterator[tuple[str, Traversable]]:
    for entry in folder.iterdir():
        if entry.is_dir():
            yield from _sources(entry, f"{name}/{entry.name}")
        elif entry.name.endswith(".py"):
            yield f"{name}/{entry.name}", entry


_ARTEFACT = re.compile(r"([0-9a-f]{2})/\1[0-9a-f]{62}")  # the end of a path: the name of a file is its hash
_fetch: Callable[[str], Path] | None = None


def fetch_artefacts_with(fetch: Callable[[str], Path]) -> None:
    """Let this process take artefacts by their SHA-256 where it does not see the files that tasks name.

    Args:
        fetch: returns the file of an artefact, from an object store for example. Raises OrthocaptureError.
    """
    global _fetch  # noqa: PLW0603 - a property of the process, set once while it starts
    _fetch = fetch


class _CallPickler(pickle.Pickler):
    """Pickles a call, and collects the paths in it."""

    def __init__(self, file: io.BytesIO, *, protocol: int) -> None:
        super().__init__(file, protocol=protocol)
        self.paths: dict[Path, None] = {}

    def persistent_id(self, obj: object) -> str | None:
        """Return a path as text, which is read as the path that the other machine has for it; None for others."""
        if not isinstance(obj, Path):
            return None
        path = obj.absolute()
        self.paths[path] = None
        return str(path)


class _CallUnpickler(pickle.Unpickler):
    """Unpickles a call with the paths of this machine."""

    def __init__(self, file: io.BytesIO, here: Mapping[str, Path]) -> None:
        super().__init__(file)
        self._here = here

    def persistent_load(self, pid: str) -> Path:
        """Return the path for what `persistent_id` gave."""
        return self._here.get(pid, Path(pid))


def _needed(path: Path) -> NeededFile:
    if path.is_file():
        sha256 = path.name if _ARTEFACT.fullmatch("/".join(path.parts[-2:])) else ""
        return NeededFile(str(path), path.stat().st_size, sha256)
    return NeededFile(str(path if path.is_dir() else path.parent), -1)


def _path_here(needed: NeededFile, host: str) -> Path:
    """Return the path at which this machine has what a task needs. Raises DataError if it does not see it."""
    path = Path(needed.path)
    if needed.size_bytes < 0:
        problem = "" if path.is_dir() else "does not see the folder"
    elif not path.is_file():
        if needed.sha256 and _fetch is not None:
            return _fetch(needed.sha256)
        problem = "does not see the file"
    else:
        problem = "" if path.stat().st_size == needed.size_bytes else "sees another file under the path"
    if problem:
        raise DataError(
            f"the machine {host} of the cluster {problem} {path}",
            where=f"{host}:{path}",
            remedy="Tasks carry paths: mount the data folder and the folder for temporary files (TMPDIR) under the "
            "same path on every machine of the cluster; let its workers fetch artefacts from the site's object "
            "store; or compute without --scheduler (docs/howto/cluster.md)",
        )
    return path
