"""A folder of backups on disk: its marker file, its states, and its lock.

BACKUP/orthocapture-backup.json   marks the folder
BACKUP/artefacts/ab/abcd…         the files of all states by hash, each written once
BACKUP/states/TIME/               one backup: orthocapture.sqlite, journal.jsonl, signatures.jsonl, state.json,
                                  optionally keys/
BACKUP/states/TIME.part           an unfinished backup, which is never used

A state gets its name by one rename, after everything in it was written and read back.
"""

from __future__ import annotations

import fcntl
import json
import shutil
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from pydantic import ValidationError

from service.core.errors import IntegrityError, StoreError
from service.core.records.base import Record
from service.store.access import close_to_others
from service.store.artefacts import TEMPORARY, ArtefactFiles
from service.store.durable_effects import Files, IdSource

MARKER = "orthocapture-backup.json"
STATES = "states"
STATE_FILE = "state.json"
PART = ".part"
_SAYS = {"format": 1, "purpose": "backups of one orthocapture data folder"}


class BackupState(Record):
    """The content of one backup; written last."""

    format: Literal[1] = 1
    at_utc: str
    host: str
    data_folder: str  # its path on that host
    database_sha256: str
    signatures_sha256: str  # "" if nothing was signed yet
    journal_sha256: str = ""  # "" if there was no journal yet
    artefacts: int
    artefact_bytes: int
    heads: dict[str, tuple[int, str]]  # chain → number and hash of its last event
    root_sha256: str  # root hash of the oldest chain, which identifies the data folder
    with_keys: bool
    faults: tuple[str, ...]  # faults of the data folder itself when it was copied; () if it verified


def copy_keys(source: Path, target: Path, files: Files, *, only: Sequence[str] | None = None) -> None:
    """Copy the files of a folder of keys, or `only` some, durably into a new one that is its owner's alone."""
    names = sorted(path.name for path in source.iterdir() if path.is_file()) if only is None else only
    files.make_directory(target, private=True)
    for name in names:
        files.write(target / name, [(source / name).read_bytes()], private=True)
        files.sync_file(target / name)
    files.sync_directory(target)


@contextmanager
def folder_errors(what: str) -> Generator[None]:
    """Turn an OSError into a StoreError that begins with `what`."""
    try:
        yield
    except OSError as error:
        raise StoreError(
            f"{what}: {error.strerror or error}",
            where=str(error.filename or ""),
            remedy="Check that the disk or share is there, its free space and permissions, then repeat the command",
        ) from error


class BackupFolder:
    """The backups of one data folder."""

    def __init__(self, folder: Path, files: Files, ids: IdSource) -> None:
        self.folder = folder
        self.files = files
        self.artefacts = ArtefactFiles(folder / "artefacts", files, ids)

    def prepare(self) -> None:
        """Make the folder, or check that it is a folder of backups. Raises StoreError."""
        with folder_errors("the folder for backups cannot be made"):
            for directory in (*reversed(self.folder.absolute().parents), self.folder.absolute()):
                if not directory.exists():
                    self.files.make_directory(directory, private=directory == self.folder.absolute())
                    self.files.sync_directory(directory.parent)
            close_to_others(self.folder, MARKER)
            if not (self.folder / MARKER).exists():
                self._mark()
            self.require()
            self.artefacts.prepare()
            self.files.make_directory(self.folder / STATES)
            self.files.sync_directory(self.folder)

    def _mark(self) -> None:
        part = self.folder / (MARKER + PART)
        if any(path != part for path in self.folder.iterdir()):
            raise StoreError(
                "this folder holds something other than backups",
                where=str(self.folder),
                remedy="Name an empty folder, or one that does not exist yet",
            )
        self.files.remove(part)
        self.files.write(part, [json.dumps(_SAYS).encode()])
        self.files.sync_file(part)
        self.files.rename(part, self.folder / MARKER)
        self.files.sync_directory(self.folder)

    def require(self) -> None:
        """Raise StoreError unless this is a folder of backups in a known format."""
        try:
            known = json.loads((self.folder / MARKER).read_bytes()) == _SAYS
        except (OSError, ValueError):
            known = False
        if not known:
            raise StoreError(
                "this is not a folder of orthocapture backups, or it is of a newer version",
                where=str(self.folder),
                remedy="Name the folder that `orthocapture store backup` has written",
            )

    @contextmanager
    def locked(self) -> Generator[None]:
        """Hold the lock that allows one backup at a time. Raises StoreError if another is running."""
        with (self.folder / MARKER).open("rb") as marker:
            try:
                fcntl.flock(marker, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise StoreError(
                    "another backup into this folder is running",
                    where=str(self.folder),
                    remedy="Wait until it has ended",
                ) from error
            yield

    def states(self) -> list[str]:
        """Return names of the complete backups, oldest first."""
        found = (self.folder / STATES).glob(f"*/{STATE_FILE}")
        return sorted(path.parent.name for path in found if path.parent.suffix != PART)

    def path(self, name: str) -> Path:
        """Return the folder of a state, which need not exist."""
        return self.folder / STATES / name

    def read(self, name: str) -> BackupState:
        """Return the record of a state.

        Raises StoreError if there is no such state, IntegrityError if it is unreadable.
        """
        if name not in self.states():
            raise StoreError(
                f"there is no backup {name!r} here" if name else "there is no complete backup here",
                where=str(self.folder),
                remedy=f"There are: {', '.join(self.states()) or 'none; repeat an unfinished backup'}",
            )
        path = self.path(name) / STATE_FILE
        try:
            return BackupState.model_validate_json(path.read_bytes())
        except (OSError, ValidationError) as error:
            raise IntegrityError(
                "the record of this backup cannot be read", where=str(path), remedy="Use an older backup"
            ) from error

    def discard(self, path: Path) -> None:
        """Delete a state; it is renamed first, so that a partly deleted one is never mistaken for complete."""
        if path.suffix != PART:
            part = path.with_name(path.name + PART)
            self.files.rename(path, part)
            self.files.sync_directory(path.parent)
            path = part
        shutil.rmtree(path)

    def discard_unfinished(self) -> None:
        """Delete unfinished states and partial files of earlier backups; complete copies stay and are used."""
        for path in (self.folder / STATES).glob(f"*{PART}"):
            self.discard(path)
        for path in (self.artefacts.folder / TEMPORARY).glob(f"*{PART}"):
            self.files.remove(path)
