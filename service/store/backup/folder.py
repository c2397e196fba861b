"""A folder of backups on disk: what it is known by, its states, and the one lock.

BACKUP/orthocapture-backup.json   says what this folder is
BACKUP/artefacts/ab/abcd…         the files of all states, by their hash, written once
BACKUP/states/TIME/               one backup: orthocapture.sqlite, signatures.jsonl, state.json, perhaps keys/
BACKUP/states/TIME.part           one that was not finished; nobody takes it for a backup

A state gets its name by one rename, after everything that it needs was written and read again.
"""

from __future__ import annotations

import fcntl
import json
import shutil
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from pydantic import ValidationError

from service.core.errors import IntegrityError, StoreError
from service.core.records.events import Record
from service.store.durable_effects import Files, Ids
from service.store.files.artefacts import TEMPORARY, ArtefactFiles

MARKER = "orthocapture-backup.json"
STATES = "states"
STATE_FILE = "state.json"
PART = ".part"
_SAYS = {"format": 1, "purpose": "backups of one orthocapture data folder"}


class BackupState(Record):
    """What one backup holds; written last."""

    format: Literal[1] = 1
    at_utc: str
    host: str
    data_folder: str  # as it was called there
    database_sha256: str
    signatures_sha256: str  # "" where nothing was signed yet
    artefacts: int
    artefact_bytes: int
    heads: dict[str, tuple[int, str]]  # chain → number and hash of its last event
    root_sha256: str  # of the oldest chain: which data folder this is
    with_keys: bool
    faults: tuple[str, ...]  # of the data folder itself, copied as it was; () for one that verified


@contextmanager
def folder_errors(what: str) -> Generator[None]:
    """What the system refuses becomes a StoreError: `what` could not be done."""
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

    def __init__(self, folder: Path, files: Files, ids: Ids) -> None:
        self.folder = folder
        self.files = files
        self.artefacts = ArtefactFiles(folder / "artefacts", files, ids)

    def prepare(self) -> None:
        """Make the folder, or see that it is one of backups. Raises StoreError."""
        with folder_errors("the folder for backups cannot be made"):
            for directory in (*reversed(self.folder.absolute().parents), self.folder.absolute()):
                if not directory.exists():
                    self.files.make_directory(directory)
                    self.files.sync_directory(directory.parent)
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
                "this folder holds something else than backups",
                where=str(self.folder),
                remedy="Name an empty folder, or one that does not exist yet",
            )
        self.files.remove(part)
        self.files.write(part, [json.dumps(_SAYS).encode()])
        self.files.sync_file(part)
        self.files.rename(part, self.folder / MARKER)
        self.files.sync_directory(self.folder)

    def require(self) -> None:
        """Raises StoreError unless this is a folder of backups that this software knows."""
        try:
            known = json.loads((self.folder / MARKER).read_bytes()) == _SAYS
        except (OSError, ValueError):
            known = False
        if not known:
            raise StoreError(
                "this is not a folder of backups of orthocapture, or of a newer version",
                where=str(self.folder),
                remedy="Name the folder that `orthocapture store backup` has written",
            )

    @contextmanager
    def locked(self) -> Generator[None]:
        """One backup at a time. Raises StoreError."""
        with (self.folder / MARKER).open("rb") as marker:
            try:
                fcntl.flock(marker, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise StoreError(
                    "another backup into this folder is under way",
                    where=str(self.folder),
                    remedy="Wait until it has ended",
                ) from error
            yield

    def states(self) -> list[str]:
        """Names of the whole backups, oldest first."""
        found = (self.folder / STATES).glob(f"*/{STATE_FILE}")
        return sorted(path.parent.name for path in found if path.parent.suffix != PART)

    def path(self, name: str) -> Path:
        """Where a state lies, or will lie."""
        return self.folder / STATES / name

    def read(self, name: str) -> BackupState:
        """What a state says of itself. Raises StoreError for a name that is none, IntegrityError."""
        if name not in self.states():
            raise StoreError(
                f"there is no backup {name!r} here" if name else "there is no whole backup here",
                where=str(self.folder),
                remedy=f"There are: {', '.join(self.states()) or 'none; an unfinished one is begun anew'}",
            )
        path = self.path(name) / STATE_FILE
        try:
            return BackupState.model_validate_json(path.read_bytes())
        except (OSError, ValidationError) as error:
            raise IntegrityError(
                "what this backup says of itself cannot be read", where=str(path), remedy="Take an older backup"
            ) from error

    def discard(self, path: Path) -> None:
        """Take away a state; as it loses its name first, no half of it is ever taken for a whole one."""
        if path.suffix != PART:
            part = path.with_name(path.name + PART)
            self.files.rename(path, part)
            self.files.sync_directory(path.parent)
            path = part
        shutil.rmtree(path)

    def discard_unfinished(self) -> None:
        """Take away what earlier backups did not finish; files that were copied by then stay and are used."""
        for path in (self.folder / STATES).glob(f"*{PART}"):
            self.discard(path)
        for path in (self.artefacts.folder / TEMPORARY).glob(f"*{PART}"):
            self.files.remove(path)
