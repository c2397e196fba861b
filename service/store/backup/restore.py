"""Restore a data folder from a backup, only into an empty folder, and verify it before it is put in place."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import delete, select

from service.core.errors import IntegrityError, OrthocaptureError, StoreError
from service.core.records.events import DataRestored
from service.store.access import KEYS
from service.store.artefacts import ArtefactFiles, chunks_of, hash_file, relative_path
from service.store.backup.folder import BackupFolder, BackupState, copy_keys, folder_errors
from service.store.database.engine import DATABASE_NAME, open_read_only
from service.store.database.tables import artefacts, control, leases, sessions
from service.store.durable_effects import DurableFiles, Files, RandomIds
from service.store.journal.lines import NAME as JOURNAL_NAME
from service.store.signatures.log import NAME as LOG_NAME
from service.store.store import Store
from service.store.verification import verify as audit
from service.store.verification.verify import AuditReport

Progress = Callable[[str, int, int], None]  # (activity, bytes done, bytes in total)
_UNDER_WAY = "restoring"  # within the destination, which is no data folder until the restoration is verified


@dataclass(frozen=True, slots=True)
class RestoreReport:
    """The restored data folder, and the result of its verification."""

    folder: Path
    name: str
    state: BackupState
    lost: tuple[str, ...]  # files that are missing or altered in the backup itself
    audit: AuditReport

    @property
    def ok(self) -> bool:
        """True if every file is there and the evidence verifies."""
        return self.audit.ok and not self.lost


def restore(
    backup: Path,
    destination: Path,
    *,
    name: str = "",
    actor: Callable[[Path], str],
    progress: Progress | None = None,
    files: Files | None = None,
) -> RestoreReport:
    """Restore a data folder as it was when a backup was made. The backup is only read.

    The report lists what a damaged backup has lost; the rest is restored. Leases, sign-ins and control by screens
    belonged to processes of that time and are left out. The restoration is recorded in the site's chain.

    Args:
        backup: the folder of backups.
        destination: an empty or new folder.
        name: the state to restore; "" for the newest.
        actor: gives the name of the person who restores, for the record, or raises if that is somebody else's; called
            with the folder once it has the accounts.
        progress: a function that is called with the number of bytes copied, then verified.
        files: durable file operations.

    Raises:
        StoreError: the destination is not empty or cannot be written.
        IntegrityError: the database or the log of signatures was altered in the backup or in copying.
        OrthocaptureError: raised by `actor`; nothing is left of the restoration.
    """
    files = files or DurableFiles()
    source = BackupFolder(backup, files, RandomIds())
    source.require()
    name = name or next(reversed(source.states()), "")
    state = source.read(name)
    with folder_errors("the data folder could not be restored"):
        _require_empty(destination)
        for directory in (*reversed(destination.absolute().parents), destination.absolute()):
            if not directory.exists():
                files.make_directory(directory, private=directory == destination.absolute())
        work = destination / _UNDER_WAY
        files.make_directory(work, private=True)
        _copy_state(source.path(name), work, state, files)
        try:
            name_of_actor = actor(work)
        except OrthocaptureError:
            shutil.rmtree(work)
            raise
        lost = _copy_files(source, work, files, progress)
        report = audit.verify(work, progress=progress)
        restored = DataRestored(state=name, at_utc=state.at_utc, folder=state.data_folder, host=state.host)
        _let_go(work, restored, name_of_actor)
        for part in (
            LOG_NAME,
            JOURNAL_NAME,
            KEYS,
            "artefacts",
            DATABASE_NAME,
        ):  # the database last: it makes this a data folder
            if (work / part).exists():
                files.rename(work / part, destination / part)
        files.sync_directory(destination)
        work.rmdir()
    return RestoreReport(destination, name, state, tuple(lost), report)


def _require_empty(destination: Path) -> None:
    if destination.exists() and (not destination.is_dir() or any(destination.iterdir())):
        if (destination / _UNDER_WAY).is_dir():
            what, remedy = "an earlier restoration into this folder was interrupted", "Delete it, then repeat this"
        else:
            what, remedy = "this folder is not empty", "Name an empty folder; nothing is ever overwritten"
        raise StoreError(what, where=str(destination), remedy=remedy)


def _copy_state(state_dir: Path, work: Path, state: BackupState, files: Files) -> None:
    expected = {
        DATABASE_NAME: state.database_sha256,
        JOURNAL_NAME: state.journal_sha256,
        LOG_NAME: state.signatures_sha256,
    }
    for part, sha256 in expected.items():
        if not sha256:
            continue
        files.write(work / part, chunks_of(state_dir / part), private=part == JOURNAL_NAME)
        files.sync_file(work / part)
        if hash_file(work / part)[0] != sha256:
            raise IntegrityError(
                f"{part} was altered in this backup or in copying",
                where=str(state_dir / part),
                remedy="Restore an older state with --state; nothing was restored",
            )
    if state.with_keys:
        copy_keys(state_dir / KEYS, work / KEYS, files)


def _copy_files(source: BackupFolder, work: Path, files: Files, progress: Progress | None) -> list[str]:
    folder = ArtefactFiles(work / "artefacts", files, RandomIds())
    folder.prepare()
    copy = open_read_only(work, files)
    try:
        with copy.reading() as connection:
            named = select(artefacts.c.sha256, artefacts.c.size_bytes).distinct().order_by(artefacts.c.sha256)
            sizes = {row.sha256: row.size_bytes for row in connection.execute(named)}
    finally:
        copy.close()
    lost: list[str] = []
    done = 0
    for sha256, size in sizes.items():
        path = source.artefacts.folder / relative_path(sha256)
        if not path.is_file():
            lost.append(f"{path}: missing in the backup")
        else:
            try:
                folder.put(chunks_of(path), expected_sha256=sha256)
            except StoreError:
                if hash_file(path)[0] == sha256:
                    raise
                lost.append(f"{path}: altered in the backup")
        done += size
        if progress is not None:
            progress("copying files", done, sum(sizes.values()))
    return lost


def _let_go(work: Path, restored: DataRestored, actor: str) -> None:
    with Store.open(work, create=False) as store, store.database.writing() as connection:
        for table in (leases, control, sessions):
            connection.execute(delete(table))
        store.append_site(connection, [restored], actor=actor)
