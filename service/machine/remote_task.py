"""One task of a job on another machine: what it needs there is checked, or brought, before it is computed.

A file that the other machine does not see is fetched from the site's object store or sent by the job's machine. A
folder that it does not see is an empty one there; the files that the task writes into it come back with the result.
"""

from __future__ import annotations

import hashlib
import importlib
import io
import os
import pickle
import platform
import re
import tempfile
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from service.core.errors import ConfigurationError, DataError, OrthocaptureError
from service.core.units import megabytes
from service.machine.executors import Place, finding_files_at, this_place
from service.machine.resources import keep_freed_memory

_DECIDES = ("compute", "core", "dataset", "machine")  # the rooms of the service whose source decides a task's result
_LARGEST_BYTES = 1_000_000  # of a task's arguments: larger ones belong into a file
_MOST_WRITTEN_BYTES = 1_000_000_000  # by a task: a worker holds them twice, and 2 GB are planned for it
Stamp = tuple[int, int, int]  # size, time of the last change, inode
REMEDY = (
    "Mount the data folder and the folder for temporary files (TMPDIR) under the same path on every machine of the "
    "cluster; let its workers fetch artefacts from the site's object store; or compute without --scheduler "
    "(docs/howto/cluster.md)"
)


@dataclass(frozen=True, slots=True)
class NeededFile:
    """A file that a task reads, or a folder that it writes into, as the job sees it.

    Attributes:
        path: its path on the job's machine.
        size_bytes: the size of the file; -1: it is a folder.
        inode: its inode there, which differs where another machine has a file or folder of its own under the path.
        changed_ns: the time of the file's last change; 0 for a folder.
        sha256: the hash of the file's content where its name says that, as of all artefacts; "" otherwise.
    """

    path: str
    size_bytes: int
    inode: int
    changed_ns: int = 0
    sha256: str = ""

    @property
    def is_folder(self) -> bool:
        """Return whether it is a folder."""
        return self.size_bytes < 0


@dataclass(frozen=True, slots=True)
class RemoteTask:
    """A call, pickled, with the files that it needs and the versions of the program that asks for it."""

    call: bytes
    files: tuple[NeededFile, ...]
    versions: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class WrittenFile:
    """A file that a task wrote on a machine that does not see its folder, with its path on the job's machine."""

    path: str
    content: bytes


@dataclass(frozen=True, slots=True)
class RemoteResult:
    """The value that a task returned, the place where it was computed, and the files for the job's machine."""

    value: Any
    place: Place
    written: tuple[WrittenFile, ...] = ()


class FileSource(Protocol):
    """Brings files of the job's machine to this one."""

    @property
    def folder(self) -> Path:
        """The folder for temporary files, which is removed when this process has ended."""
        ...

    def provided(self, files: Sequence[NeededFile]) -> AbstractContextManager[Sequence[Path]]:
        """Provide the files; a path on this machine stands for the same file each time.

        Raises DataError: a file has changed since the task was made, or is too large to be sent.
        """
        ...


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


def compute_there(task: RemoteTask, source: FileSource | None = None) -> RemoteResult:
    """Compute a task on the machine that it was sent to.

    Args:
        task: the task.
        source: brings the files that this machine does not see; None: nothing does.

    Raises:
        ConfigurationError: this machine has other versions than the one that asks.
        DataError: this machine does not see a file, or sees another one under its path.
    """
    place = this_place()
    differing = different_versions(dict(task.versions), versions_here())
    if differing:
        raise version_error(place.host, differing)
    with _places(task.files, place.host, source) as places:
        _prepare_process()
        importlib.import_module("cv2").setNumThreads(1)  # as in the processes of the job's own machine
        call: Callable[[], Any] = _CallUnpickler(io.BytesIO(task.call), places).load()
        try:
            with finding_files_at(places.files):
                value = call()
        except Exception as error:
            if not places.differ:
                raise
            raise places.error_there(error) from None
        return RemoteResult(places.value_there(value), place, places.written(place.host))


def write_here(files: Sequence[WrittenFile]) -> None:
    """Write on the job's machine what a task wrote on another; each file appears when it is durable.

    Raises OSError.
    """
    for file in files:
        path = Path(file.path)
        path.parent.mkdir(parents=True, exist_ok=True)
        beside = path.with_name(f".{path.name}.{os.getpid()}.part")
        try:
            with beside.open("wb") as output:
                output.write(file.content)
                output.flush()
                os.fsync(output.fileno())
            beside.replace(path)
        finally:
            beside.unlink(missing_ok=True)


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


@dataclass
class _Places:
    """States where this machine has what a task names; other paths are the same on both machines."""

    files: dict[str, Path] = field(default_factory=dict[str, Path])  # those with another path here
    folders: dict[str, Path] = field(default_factory=dict[str, Path])
    sent: dict[str, Stamp | None] = field(default_factory=dict[str, "Stamp | None"])  # of the files that arrived

    @property
    def differ(self) -> bool:
        """Return whether a path differs."""
        return bool(self.files or self.folders)

    def here(self, there: str) -> Path:
        """Return the path on this machine."""
        path = Path(there)
        if there in self.files:
            return self.files[there]
        for folder in (path, *path.parents):
            if str(folder) in self.folders:
                return self.folders[str(folder)] / path.relative_to(folder)
        return path

    def text_there(self, text: str) -> str:
        """Return a text with the paths of the job's machine."""
        for there, here in (*self.files.items(), *self.folders.items()):
            text = text.replace(str(here), there)
        return text

    def value_there(self, value: Any) -> Any:
        """Return a value with the paths of the job's machine, in texts as well."""
        if not self.differ:
            return value
        written = io.BytesIO()
        _AnswerPickler(written, self).dump(value)
        return _AnswerUnpickler(io.BytesIO(written.getvalue())).load()

    def error_there(self, error: Exception) -> Exception:
        """Return an error with the paths of the job's machine; the error itself if it cannot be pickled."""
        try:
            named: Exception = self.value_there(error)
        except (pickle.PicklingError, AttributeError, TypeError):
            return error
        return named.with_traceback(error.__traceback__)

    def written(self, host: str) -> tuple[WrittenFile, ...]:
        """Read what the task wrote, for the job's machine. Raises DataError if it is too much."""
        found = [
            (str(Path(there) / file.relative_to(here)), file)
            for there, here in self.folders.items()
            for file in sorted(here.rglob("*"))
            if file.is_file()
        ]
        found += [
            (there, self.files[there]) for there, stamp in self.sent.items() if stamp_of(self.files[there]) != stamp
        ]
        size_bytes = sum(file.stat().st_size for _, file in found)
        if size_bytes > _MOST_WRITTEN_BYTES:
            raise DataError(
                f"the machine {host} of the cluster does not see folders into which a task writes, and has "
                f"{megabytes(size_bytes):.0f} MB for them; {megabytes(_MOST_WRITTEN_BYTES):.0f} MB can be sent back",
                where=f"{host}:{found[0][0]}",
                remedy=REMEDY,
            )
        return tuple(WrittenFile(there, file.read_bytes()) for there, file in found)


def stamp_of(file: Path) -> Stamp | None:
    """Return what differs once a file has been changed; None if it is not there."""
    try:
        stat = file.stat()
    except FileNotFoundError:
        return None
    return stat.st_size, stat.st_mtime_ns, stat.st_ino


class _CallUnpickler(pickle.Unpickler):
    """Unpickles a call with the paths of this machine."""

    def __init__(self, file: io.BytesIO, places: _Places) -> None:
        super().__init__(file)
        self._places = places

    def persistent_load(self, pid: str) -> Path:
        """Return the path for what `persistent_id` gave."""
        return self._places.here(pid)


class _AnswerPickler(pickle.Pickler):
    """Pickles an answer with the paths of the job's machine."""

    def __init__(self, file: io.BytesIO, places: _Places) -> None:
        super().__init__(file, protocol=pickle.HIGHEST_PROTOCOL)
        self._places = places

    def persistent_id(self, obj: object) -> Path | str | None:
        """Return a path or a text as it reads on the job's machine; None if it reads the same here."""
        if isinstance(obj, Path) or type(obj) is str:
            text = str(obj)
            there = self._places.text_there(text)
            if there != text:
                return Path(there) if isinstance(obj, Path) else there
        return None


class _AnswerUnpickler(pickle.Unpickler):
    """Unpickles what `_AnswerPickler` wrote."""

    def persistent_load(self, pid: Path | str) -> Path | str:
        """Return what `persistent_id` gave."""
        return pid


def _needed(path: Path) -> NeededFile:
    if path.is_file():
        sha256 = path.name if _ARTEFACT.fullmatch("/".join(path.parts[-2:])) else ""
        stat = path.stat()
        return NeededFile(str(path), stat.st_size, stat.st_ino, stat.st_mtime_ns, sha256)
    folder = path if path.is_dir() else path.parent
    return NeededFile(str(folder), -1, folder.stat().st_ino if folder.is_dir() else -1)


@contextmanager
def _places(files: Sequence[NeededFile], host: str, source: FileSource | None) -> Generator[_Places]:
    """Provide what a task needs, some of it at other paths. Raises DataError if this machine cannot have it."""
    places = _Places()
    asked: list[NeededFile] = []
    with ExitStack() as open_until_done:
        for needed in files:
            if _sees(needed, surely=source is not None):
                continue
            if needed.is_folder:
                made = tempfile.TemporaryDirectory(
                    prefix="orthocapture-task-", dir=None if source is None else source.folder
                )
                places.folders[needed.path] = Path(open_until_done.enter_context(made)).resolve()
                continue
            fetched = _fetched(needed, host, source)
            if fetched is None:
                asked.append(needed)
            else:
                places.files[needed.path] = fetched
        if asked and source is not None:
            arrived = open_until_done.enter_context(source.provided(asked))
            places.files |= {needed.path: file for needed, file in zip(asked, arrived, strict=True)}
            places.sent |= {needed.path: stamp_of(file) for needed, file in zip(asked, arrived, strict=True)}
        yield places


def _sees(needed: NeededFile, *, surely: bool) -> bool:
    """Return whether this machine sees a file or folder under its path.

    `surely`: a file of the same size does not suffice, unless its name says what is in it.
    """
    path = Path(needed.path)
    try:
        same = path.stat().st_ino == needed.inode
        if needed.is_folder:
            return same and path.is_dir()
        return (
            path.is_file()
            and path.stat().st_size == needed.size_bytes
            and (same or not surely or needed.sha256 != "")
        )
    except OSError:  # it may not look there
        return False


def _fetched(needed: NeededFile, host: str, source: FileSource | None) -> Path | None:
    """Return an artefact from the object store; None if the source is to bring the file.

    Raises DataError if nothing can bring it, and the error of the object store.
    """
    if needed.sha256 and _fetch is not None:
        try:
            return _fetch(needed.sha256)
        except OrthocaptureError:
            if source is None:
                raise
    if source is not None:
        return None
    problem = "sees another file under the path" if os.path.lexists(needed.path) else "does not see the file"
    raise DataError(
        f"the machine {host} of the cluster {problem} {needed.path}", where=f"{host}:{needed.path}", remedy=REMEDY
    )
