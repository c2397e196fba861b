"""Watches a folder for finished mesh exports, by polling, since the folder is often an SMB share."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from drivers.errors import IncompleteExportError, UnreadableFileError
from drivers.folder_files import files_below
from drivers.foreign_code import reading
from drivers.interfaces import ScanExport
from drivers.meshes.foreign_text import name_of
from drivers.meshes.mesh_file import MESH_SUFFIXES, export_of
from drivers.meshes.mesh_format import check_complete


@dataclass
class _Seen:
    signature: tuple[tuple[str, int, int], ...]  # name, size, mtime of the mesh and its companions
    since_s: float
    export: ScanExport | None = None
    trouble: str = ""


class WatchedExports(NamedTuple):
    """The findings of a look into the folder.

    Attributes:
        complete: the complete exports, oldest first.
        arriving: the number of those that are whole, but have not been unchanged for long enough: no fault.
        problems: one sentence for each file that is incomplete or cannot be used.
    """

    complete: tuple[ScanExport, ...]
    arriving: int
    problems: tuple[str, ...]


class ExportWatch:
    """Finds the complete exports in a folder.

    `check` says by an error that a file is incomplete, or cannot be used.

    An export counts as complete when this host has seen its sizes and modification times unchanged for `stable_s`.
    The age of a file is not used, because the clocks of the share and of this host may differ.
    """

    def __init__(
        self,
        folder: Path,
        stable_s: float,
        monotonic: Callable[[], float] = time.monotonic,
        *,
        suffixes: tuple[str, ...] = MESH_SUFFIXES,
        check: Callable[[Path], None] = check_complete,
    ) -> None:
        self._folder = folder
        self._stable_s = stable_s
        self._monotonic = monotonic
        self._suffixes = suffixes
        self._check = check
        self._seen: dict[Path, _Seen] = {}

    def poll(self) -> WatchedExports:
        """Return what is in the folder now.

        Raises DeviceUnavailableError if the folder cannot be read.
        """
        now = self._monotonic()
        present = mesh_files(self._folder, self._suffixes)
        self._seen = {path: seen for path, seen in self._seen.items() if path in present}
        exports: list[tuple[int, ScanExport]] = []
        arriving = 0
        problems: list[str] = []
        for path in present:
            try:
                seen = self._observe(path, now)
            except OSError as error:
                self._seen.pop(path, None)
                problems.append(f"{name_of(path)}: cannot be read ({error.strerror})")
                continue
            if seen.export is None:
                problems.append(f"{name_of(path)}: {seen.trouble}")
            elif now - seen.since_s >= self._stable_s:
                exports.append((seen.signature[0][2], seen.export))
            else:
                arriving += 1
        exports.sort(key=lambda item: (item[0], item[1].name))
        return WatchedExports(tuple(export for _, export in exports), arriving, tuple(problems))

    def _observe(self, path: Path, now: float) -> _Seen:
        old = self._seen.get(path)
        trouble = ""
        export = None
        files: tuple[Path, ...] = (path,)
        own = _signature((path,))
        if old is not None and old.export is not None and _signature(old.export.files) == old.signature:
            return old
        try:
            with reading(path, "an export", "Export it again"):
                if old is None or old.signature[:1] != own or old.trouble:
                    self._check(path)
                export = export_of(path)
                files = export.files
        except IncompleteExportError as error:
            trouble = str(error)
        except UnreadableFileError as error:
            trouble = f"cannot be used: {error}"
        signature = _signature(files)
        since_s = old.since_s if old is not None and old.signature == signature and old.export is not None else now
        seen = _Seen(signature, since_s, export, trouble)
        self._seen[path] = seen
        return seen


def mesh_files(folder: Path, suffixes: tuple[str, ...] = MESH_SUFFIXES) -> list[Path]:
    """The files with these extensions in a folder and its subfolders, sorted.

    Without hidden files, and without links that lead out of the folder.

    Raises DeviceUnavailableError if the folder cannot be read.
    """

    def belongs(path: Path) -> bool:
        hidden = any(part.startswith((".", "~")) for part in path.relative_to(folder).parts)
        return path.suffix.lower() in suffixes and not hidden

    return files_below(folder, belongs)


def _signature(files: tuple[Path, ...]) -> tuple[tuple[str, int, int], ...]:
    stats = [(path.name, path.stat()) for path in files]
    return tuple((name, stat.st_size, stat.st_mtime_ns) for name, stat in stats)
