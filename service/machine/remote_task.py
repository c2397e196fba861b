"""One task of a job on another machine: what it needs there is checked before it is computed."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import pickle
import platform
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, cast

import numpy as np

from service.core.errors import ConfigurationError, DataError
from service.core.units import megabytes
from service.machine.executors import Place, this_place
from service.machine.resources import keep_freed_memory

_DECIDES = ("compute", "core", "machine")  # the rooms of the service whose source decides a task's result
_LARGEST_BYTES = 1_000_000  # of a task's arguments: larger ones belong into a file


@dataclass(frozen=True, slots=True)
class NeededFile:
    """A file that a task reads, with its size as the job sees it; -1 for a folder that it writes into."""

    path: str
    size_bytes: int


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
    data = pickle.dumps(call, protocol=pickle.HIGHEST_PROTOCOL)
    if len(data) > _LARGEST_BYTES:
        raise ConfigurationError(
            f"the arguments of one task have {megabytes(len(data)):.1f} MB",
            remedy="Pass the path of a file",
        )
    files = {path: _needed(path) for path in _paths_in(call)}
    return RemoteTask(data, tuple(files.values()), tuple(versions_here().items()))


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
    for needed in task.files:
        _require(needed, place.host)
    _prepare_process()
    importlib.import_module("cv2").setNumThreads(1)  # as in the processes of the job's own machine
    call: Callable[[], Any] = pickle.loads(task.call)
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


def _paths_in(value: object) -> Iterator[Path]:
    """Yield the paths in the arguments of a call."""
    if isinstance(value, Path):
        yield value
    elif isinstance(value, partial):
        called = cast("partial[Any]", value)
        yield from _paths_in([called.func, *called.args, *called.keywords.values()])
    elif isinstance(value, (list, tuple)):
        for part in cast("list[object]", value):
            yield from _paths_in(part)
    elif isinstance(value, dict):
        yield from _paths_in(list(cast("dict[object, object]", value).values()))
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            yield from _paths_in(getattr(value, field.name))


def _needed(path: Path) -> NeededFile:
    path = path.absolute()
    if path.is_file():
        return NeededFile(str(path), path.stat().st_size)
    return NeededFile(str(path if path.is_dir() else path.parent), -1)


def _require(needed: NeededFile, host: str) -> None:
    """Raise DataError if this machine does not see what a task needs."""
    path = Path(needed.path)
    if needed.size_bytes < 0:
        problem = "" if path.is_dir() else "does not see the folder"
    elif not path.is_file():
        problem = "does not see the file"
    else:
        problem = "" if path.stat().st_size == needed.size_bytes else "sees another file under the path"
    if problem:
        raise DataError(
            f"the machine {host} of the cluster {problem} {path}",
            where=f"{host}:{path}",
            remedy="Tasks carry paths: mount the data folder and the folder for temporary files (TMPDIR) under the "
            "same path on every machine of the cluster, or compute without --scheduler",
        )
