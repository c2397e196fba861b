"""The folder of an export: filled beside its place, there when it is whole; goes on after an interruption."""

from __future__ import annotations

import contextlib
import fcntl
import json
import shutil
from collections.abc import Callable, Generator
from pathlib import Path

from service.core.errors import ConfigurationError, DataError
from service.store.durable_effects import DurableFiles
from service.store.files.artefacts import hash_file

_PART = ".part"  # ends the name of an unfinished file or folder
_ABOUT = ".export"  # ends the name of the file beside it that says what is being written, and locks it
_DISK = DurableFiles()
SUMS = "SHA256SUMS"


class ExportFolder:
    """Where a format's writer puts its files."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._written: set[str] = set()

    def file(self, name: str, make: Callable[[], bytes]) -> None:
        """Write a file, unless an interrupted export wrote it; `name` is relative, with `/`."""
        self.written_by(name, lambda part: part.write_bytes(make()))

    def text(self, name: str, text: str) -> None:
        """Write a file of UTF-8 text."""
        self.file(name, text.encode)

    def json(self, name: str, document: object) -> None:
        """Write a file of JSON."""
        self.text(name, json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False) + "\n")

    def written_by(self, name: str, write: Callable[[Path], object]) -> None:
        """Let `write` make a file at a path beside it; it has its name only when it is whole.

        Raises:
            ConfigurationError: the name was given already, or leads out of the folder.
        """
        path = self._root / name
        if name in self._written or not path.resolve().is_relative_to(self._root.resolve()):
            raise ConfigurationError("an exporter writes this file twice or elsewhere", where=name)
        self._written.add(name)
        if path.is_file():
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f".{path.name}{_PART}")
        write(part)
        _DISK.sync_file(part)
        part.replace(path)

    def close(self) -> None:
        """Remove what does not belong here, and write the checksums of everything that does."""
        lines: list[str] = []
        for path in sorted(self._root.rglob("*")):
            name = path.relative_to(self._root).as_posix()
            if path.is_dir():
                continue
            if name not in self._written:
                path.unlink()
                continue
            lines.append(f"{hash_file(path)[0]}  {name}\n")
        sums = self._root / f".{SUMS}{_PART}"
        sums.write_bytes("".join(lines).encode())
        _DISK.sync_file(sums)
        sums.replace(self._root / SUMS)
        for folder in (self._root, *(path for path in self._root.rglob("*") if path.is_dir())):
            _DISK.sync_directory(folder)


@contextlib.contextmanager
def export_folder(
    target: Path, identity: str, leaving: Callable[[Path], None] = lambda _sums: None
) -> Generator[ExportFolder]:
    """A folder that appears at `target` when the block ends without an error.

    Until then it is `.NAME.part` beside it. After an interruption the same export goes on with the files that are
    whole; another one begins anew.

    Args:
        target: a new folder in an existing one.
        identity: of what is exported, and how.
        leaving: called with the list of checksums when all is written, before the folder has its name.

    Raises:
        DataError: the target exists, its parent does not, or something else has the name of the unfinished folder.
        ConfigurationError: another process is writing the same export.
    """
    if target.exists() or target.is_symlink():
        raise DataError(
            "the folder exists already", where=str(target), remedy="Name a new one; nothing is overwritten"
        )
    root, about = (target.with_name(f".{target.name}{ending}") for ending in (_PART, _ABOUT))
    if root.exists() and not about.is_file():
        raise DataError("a folder that is no export has this name", where=str(root), remedy="Move it away")
    try:
        lock = about.open("a+b")
    except OSError as error:
        raise DataError(
            f"the folder cannot be made: {error.strerror}", where=str(target), remedy="Make its parent folder first"
        ) from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ConfigurationError(
                "another process is writing this export", where=str(target), remedy="Wait until it has ended"
            ) from error
        _begin(root, about, identity)
        folder = ExportFolder(root)
        yield folder
        folder.close()
        leaving(root / SUMS)
        root.replace(target)
        about.unlink()
    _DISK.sync_directory(target.parent)


def _begin(root: Path, about: Path, identity: str) -> None:
    """Keep the files of the same export, remove those of another."""
    if root.is_dir() and about.read_text(encoding="utf-8") == identity:
        return
    about.write_text("", encoding="utf-8")  # an interruption from here on begins anew
    if root.exists():
        shutil.rmtree(root)
    root.mkdir()
    about.write_text(identity, encoding="utf-8")
