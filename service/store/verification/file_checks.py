"""Verification of the recorded files: each is hashed again, and files without a row are found."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Protocol

from service.core.errors import StoreError
from service.store.artefacts import TEMPORARY, hash_file, relative_path
from service.store.verification.chain_checks import Fault, FileState

Progress = Callable[[str, int, int], None]  # (activity, bytes done, bytes in total)


class Elsewhere(Protocol):
    """Another place that may have a file that is not in the folder."""

    def state(self, sha256: str, shown: str) -> FileState:
        """Return what is found of a file there; its `problem` says why nothing was."""
        ...


def hash_files(
    folder: Path,
    artefact_rows: Iterable[Mapping[str, Any]],
    progress: Progress | None,
    elsewhere: Elsewhere | None = None,
) -> dict[str, FileState]:
    """Hash every file that the rows name, by its recorded SHA-256; one that is not here is looked for elsewhere."""
    wanted = {str(row["sha256"]): int(row["size_bytes"]) for row in artefact_rows}
    total, done = sum(wanted.values()), 0
    states: dict[str, FileState] = {}
    for sha256, size in wanted.items():
        states[sha256] = _file_state(folder, sha256, elsewhere)
        done += size
        if progress is not None:
            progress("hashing files again", done, total)
    return states


def _file_state(folder: Path, sha256: str, elsewhere: Elsewhere | None) -> FileState:
    try:
        name = relative_path(sha256)
    except StoreError:
        return FileState(sha256, "", 0, "the row names no SHA-256")
    path = folder / name
    shown = str(Path(folder.name) / name)
    if path.is_symlink() or not path.is_file():
        if elsewhere is not None and not path.is_symlink() and not path.exists():
            return elsewhere.state(sha256, shown)
        return FileState(shown, "", 0, "the file is missing")
    try:
        digest, size = hash_file(path)
    except OSError as error:
        return FileState(shown, "", 0, f"the file cannot be read: {error.strerror}")
    return FileState(shown, digest, size, "")


def elsewhere_notes(states: Iterable[FileState]) -> list[str]:
    """Return notes on the files that are not in the folder, by how each was checked; none if all are here."""
    found = list(states)
    read = sum(state.how == "fetched" and not state.problem for state in found)
    stated = sum(state.how == "stated" and not state.problem for state in found)
    only = "in the object store alone"
    notes: list[str] = []
    if read:
        notes.append(f"{read} of {len(found)} files are {only}: their content was fetched and hashed")
    if stated:
        notes.append(
            f"{stated} of {len(found)} files are {only} and were NOT read: the store itself states their SHA-256"
        )
    return notes


def unread_files(states: Iterable[FileState]) -> list[str]:
    """Return a sentence on the files that only an object store has that is away; none if there are none."""
    found = list(states)
    away = [state for state in found if state.how == "away"]
    if not away:
        return []
    return [
        f"{len(away)} of {len(found)} files are not here and are not compared, because their object store is away: "
        f"{away[0].problem}"
    ]


def unlisted_files(folder: Path, listed: frozenset[str]) -> tuple[list[str], list[Fault]]:
    """Return (notes, faults) on files that no row names.

    Leftovers of crashes are notes: partial and unrecorded files.
    """
    notes: list[str] = []
    foreign: list[Fault] = []
    for path in sorted(path for path in folder.rglob("*") if not path.is_dir() or path.is_symlink()):
        relative = path.relative_to(folder)
        shown = str(Path(folder.name) / relative)
        if relative.parts[0] == TEMPORARY and path.suffix == ".part":
            notes.append(f"{shown}: left over from an interrupted write; no record refers to it")
        elif path.name in listed and relative == relative_path(path.name):
            continue
        elif not path.is_symlink() and path.is_file() and hash_file(path)[0] == path.name:
            notes.append(
                f"{shown}: stored but never recorded (interrupted before the record); no record refers to it"
            )
        else:
            foreign.append(Fault(None, None, shown, "this file is not in the evidence and is not a crash's leftover"))
    return notes, foreign
