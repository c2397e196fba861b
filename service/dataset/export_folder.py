"""The folder of an export: filled beside its place, there when it is whole; goes on after an interruption."""

from __future__ import annotations

import contextlib
import fcntl
import json
import shutil
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Literal, NamedTuple

from service.core.errors import ConfigurationError, DataError
from service.store.artefacts import hash_file
from service.store.durable_effects import DurableFiles


@dataclass(frozen=True, slots=True)
class ListedFile:
    """A file of an export.

    Attributes:
        path: the file's path, relative to the folder, with `/`.
        sha256: hash of its content.
        size_bytes: size of its content.
    """

    path: str
    sha256: str
    size_bytes: int


_PART = ".part"  # ends the name of an unfinished file or folder
_ABOUT = ".export"  # ends the name of the file beside it that says what is being written, and locks it
_DISK = DurableFiles()
SUMS = "SHA256SUMS"


def check_folder(folder: Path) -> int:
    """Compare an exported folder with its list of checksums. Returns the number of files.

    Raises:
        DataError: there is no list, or a file is missing, altered or not listed.
    """
    remedy = "Export it again"
    try:
        lines = (folder / SUMS).read_text(encoding="utf-8").splitlines()
    except OSError as error:
        what = f"the list of checksums cannot be read: {error.strerror}"
        raise DataError(what, where=str(folder), remedy=remedy) from error
    except UnicodeDecodeError as error:
        raise DataError("the list of checksums is not text", where=str(folder), remedy=remedy) from error
    stated = {name: sha256 for sha256, _, name in (line.partition("  ") for line in lines)}
    present = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()} - {SUMS}
    if present != set(stated):
        name = min(present ^ set(stated))
        what = "is missing" if name in stated else "is not in the list of checksums"
        raise DataError(f"{name} {what}", where=str(folder), remedy=remedy)
    for name, sha256 in stated.items():
        if hash_file(folder / name)[0] != sha256:
            raise DataError(f"{name} was altered", where=str(folder), remedy=remedy)
    return len(stated)


class Part(NamedTuple):
    """The role of a file for a view."""

    role: Literal["image", "depth", "mask", "arrays"]
    view: str


def json_bytes(document: object) -> bytes:
    """Return a document as the UTF-8 text of a JSON file."""
    return (json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False) + "\n").encode()


class ExportFolder:
    """The folder into which a format's writer puts its files."""

    def __init__(self, root: Path, told: Callable[[int], None] = lambda _count: None, *, suffix: str = "") -> None:
        """Write into `root`; `told` is called with the number of files after each of them.

        `suffix` distinguishes the unfinished files of this process from those of others that write into the folder.
        """
        self.root, self._told, self._suffix = root, told, suffix
        self._written: dict[str, ListedFile | None] = {}
        self.parts: dict[str, dict[str, str]] = {}  # what belongs to views: role → view → file

    def file(self, name: str, make: Callable[[], bytes], part: Part | None = None) -> None:
        """Write a file, unless an interrupted export wrote it; `name` is relative, with `/`."""
        self.written_by(name, lambda path: path.write_bytes(make()), part)

    def anew(self, name: str, make: Callable[[], bytes]) -> None:
        """Write a file, also if an interrupted export wrote it."""
        (self.root / name).unlink(missing_ok=True)
        self.file(name, make)

    def text(self, name: str, text: str) -> None:
        """Write a file of UTF-8 text."""
        self.file(name, text.encode)

    def json(self, name: str, document: object) -> None:
        """Write a file of JSON."""
        self.file(name, lambda: json_bytes(document))

    def written_by(self, name: str, write: Callable[[Path], object], part: Part | None = None) -> None:
        """Let `write` make a file at a temporary path; the file gets its name only when it is complete.

        Args:
            name: the file's name, relative, with `/`.
            write: makes the file at the path that it gets.
            part: the view to which it belongs, if it does.

        Raises:
            ConfigurationError: the name was given already, or leads out of the folder.
        """
        path = self.root / name
        if name in self._written or not path.resolve().is_relative_to(self.root.resolve()):
            raise ConfigurationError("an exporter writes this file twice, or outside its folder", where=name)
        self._named(name, part)
        if not path.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            beside = path.with_name(f".{path.name}{self._suffix}{_PART}")
            write(beside)
            _DISK.sync_file(beside)
            beside.replace(path)
        self._told(len(self._written))

    def has(self, name: str) -> bool:
        """Return whether a file is there and complete."""
        return (self.root / name).is_file()

    def _named(self, name: str, part: Part | None) -> None:
        self._written[name] = None
        if part is not None:
            self.parts.setdefault(part.role, {})[part.view] = name

    def listed(self) -> list[ListedFile]:
        """Return the files that were written up to now, in order of their names; each is hashed once."""
        found: list[ListedFile] = []
        for name, known in sorted(self._written.items()):
            path = self.root / name
            if known is None and not path.is_file():
                continue  # the one that is being made
            found.append(known or ListedFile(name, *hash_file(path)))
            self._written[name] = found[-1]
        return found

    def close(self) -> None:
        """Remove what does not belong here, and write the checksums of everything that does."""
        for path in self.root.rglob("*"):
            if path.is_file() and path.relative_to(self.root).as_posix() not in self._written:
                path.unlink()
        lines = [f"{file.sha256}  {file.path}\n" for file in self.listed()]
        sums = self.root / f".{SUMS}{_PART}"
        sums.write_bytes("".join(lines).encode())
        _DISK.sync_file(sums)
        sums.replace(self.root / SUMS)
        for folder in (self.root, *(path for path in self.root.rglob("*") if path.is_dir())):
            _DISK.sync_directory(folder)


class ListedFiles(ExportFolder):
    """Lists what a writer would write, and writes nothing."""

    def __init__(self) -> None:
        """List no file yet."""
        super().__init__(Path())
        self.of_views: dict[str, list[str]] = {}  # view → its files

    def written_by(self, name: str, write: Callable[[Path], object], part: Part | None = None) -> None:
        """Remember the name, and write nothing."""
        del write
        self._named(name, part)
        if part is not None:
            self.of_views.setdefault(part.view, []).append(name)

    def anew(self, name: str, make: Callable[[], bytes]) -> None:
        """Remember the name, and write nothing."""
        self.file(name, make)

    @property
    def count(self) -> int:
        """Number of files."""
        return len(self._written)


def count_files(write: Callable[[ExportFolder], object]) -> int:
    """Return the number of files that a writer makes; none is made."""
    listed = ListedFiles()
    write(listed)
    return listed.count


@contextlib.contextmanager
def export_folder(
    target: Path,
    identity: str,
    leaving: Callable[[Path], None] = lambda _sums: None,
    told: Callable[[int], None] = lambda _count: None,
) -> Generator[ExportFolder]:
    """Yield a folder that appears at `target` when the block ends without an error.

    Until then it is `.NAME.part` beside it. After an interruption the same export keeps the files that are complete;
    another export starts again.

    Args:
        target: a new folder in an existing one.
        identity: a text that identifies what is exported, and how.
        leaving: a function called with the list of checksums when all is written, before the folder has its name.
        told: a function that is called with the number of files that are there, after each of them.

    Raises:
        DataError: the target exists, its parent does not, or something else has the name of the unfinished folder.
        ConfigurationError: another process is writing the same export.
    """
    if target.exists() or target.is_symlink():
        raise DataError(
            "the folder exists already", where=str(target), remedy="Name a new one; nothing is overwritten"
        )
    root, about = _beside(target)
    if root.exists() and not about.is_file():
        raise DataError("a folder that is not an export has this name", where=str(root), remedy="Move it away")
    try:
        lock = about.open("a+b")
    except OSError as error:
        raise DataError(
            f"the folder cannot be made: {error.strerror}", where=str(target), remedy="Make its parent folder first"
        ) from error
    with lock:
        _lock(lock, target)
        _begin(root, about, identity)
        folder = ExportFolder(root, told)
        yield folder
        folder.close()
        leaving(root / SUMS)
        root.replace(target)
        about.unlink()
    _DISK.sync_directory(target.parent)


def being_written(target: Path) -> bool:
    """Return whether a process is writing the export of this folder now."""
    about = _beside(target)[1]
    try:
        with about.open("rb") as lock:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # there is none
        return False
    return False


def interrupted(target: Path) -> bool:
    """Return whether an export of this folder was started and neither ended nor discarded, or is being written."""
    root, about = _beside(target)
    return root.is_dir() and about.is_file()


def discard(target: Path) -> None:
    """Remove what an interrupted export left.

    Raises:
        DataError: there is none.
        ConfigurationError: a process is writing it.
    """
    root, about = _beside(target)
    if not interrupted(target):
        raise DataError("no interrupted export has this name", where=target.name)
    with about.open("a+b") as lock:
        _lock(lock, target)
        shutil.rmtree(root)
        about.unlink()


def _beside(target: Path) -> tuple[Path, Path]:
    """Return the unfinished folder, and the file that says what is being written and locks it."""
    return target.with_name(f".{target.name}{_PART}"), target.with_name(f".{target.name}{_ABOUT}")


def _lock(file: IO[bytes], target: Path) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise ConfigurationError(
            "another process is writing this export", where=str(target), remedy="Wait until it has ended"
        ) from error


def _begin(root: Path, about: Path, identity: str) -> None:
    """Keep the files of the same export, remove those of another."""
    if root.is_dir() and about.read_text(encoding="utf-8") == identity:
        return
    about.write_text("", encoding="utf-8")  # an export that is interrupted from here on starts again
    if root.exists():
        shutil.rmtree(root)
    root.mkdir()
    about.write_text(identity, encoding="utf-8")
