"""Backs up a data folder while it is in use, into a folder of backups with a marker file, states and a lock.

BACKUP/orthocapture-backup.json   marks the folder
BACKUP/artefacts/ab/abcd…         the files of all states by hash, each written once
BACKUP/states/TIME/               one backup: orthocapture.sqlite, journal.jsonl, signatures.jsonl, state.json,
                                  optionally keys/
BACKUP/states/TIME.part           an unfinished backup, which is never used

A state gets its name by one rename, after everything in it was written and read back. The database is copied first,
in one consistent state, with SQLite's backup interface; every file named in that state is then already on disk, and
so is every line of the journal up to the one that this state holds. What a run adds meanwhile belongs to the next
backup.
"""

from __future__ import annotations

import fcntl
import json
import shutil
import socket
import sqlite3
from collections.abc import Callable, Generator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import ValidationError
from sqlalchemy import Connection, select

from service.core.errors import IntegrityError, StoreError
from service.core.records.base import Record
from service.core.units import gigabytes
from service.store.artefacts import TEMPORARY, ArtefactFiles, chunks_of, hash_file, relative_path
from service.store.data_folder import KEYS, PEPPER, close_to_others
from service.store.database.engine import DATABASE_NAME, LOOK, open_read_only
from service.store.database.opening import require_sqlite
from service.store.database.tables import artefacts, event_index, heads, runs
from service.store.durable_effects import Clock, DurableFiles, Files, IdSource, RandomIds, SystemClock, utc_text
from service.store.journal import NAME as JOURNAL_NAME
from service.store.journal import first_lines
from service.store.objects.reading import SpoolReader
from service.store.signatures.checkpoints import KeyFolder, read_every_checkpoint
from service.store.signatures.log import NAME as LOG_NAME
from service.store.signatures.log import read_log
from service.store.verification import verify as verification

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


Progress = Callable[[str, int, int], None]  # (activity, bytes done, bytes in total)
_SPARE_BYTES = 64 << 20  # must be free beyond what is copied


@dataclass(frozen=True, slots=True)
class BackupReport:
    """The result of a backup."""

    folder: Path
    name: str  # the state's name, for `orthocapture store restore --state NAME`
    state: BackupState
    copied: int  # number of files copied this time
    copied_bytes: int
    present: int  # number of files already there from earlier backups


@dataclass(frozen=True, slots=True)
class BackupOptions:
    """The options of a backup, besides copying what is new.

    Attributes:
        with_keys: true to copy the private signing key, too.
        read_all: true to hash again every file that earlier backups copied, and to copy altered ones again.
        keep: number of newest states to keep; None keeps all. If this state has faults, none is discarded.
    """

    with_keys: bool = False
    read_all: bool = False
    keep: int | None = None


_NEW_FILES_ONLY = BackupOptions()


def back_up(
    data_dir: Path,
    destination: Path,
    options: BackupOptions = _NEW_FILES_ONLY,
    *,
    progress: Progress | None = None,
    files: Files | None = None,
    clock: Clock | None = None,
) -> BackupReport:
    """Copy a data folder into a folder of backups; after an interruption, a repeated call continues the copy.

    Args:
        data_dir: the data folder, which a run may be using.
        destination: the folder of backups: new, empty, or with earlier backups of this data folder.
        options: the backup's options.
        progress: a function that is called with the number of bytes copied.
        files: durable file operations.
        clock: gives the state its name.

    Raises:
        StoreError: there is no data, or the destination is unusable or too small; no backup was made.
        IntegrityError: a written file does not read back as it was; no backup was made.
    """
    require_sqlite(data_dir)
    folder = BackupFolder(destination, files or DurableFiles(), RandomIds())
    here, there = data_dir.resolve(), destination.resolve()
    if here == there or here in there.parents or there in here.parents:
        raise StoreError(
            "a backup within its own data folder would be lost with it",
            where=str(destination),
            remedy="Name a folder on another disk",
        )
    source = open_read_only(data_dir, DurableFiles())  # raises if there is no data, before anything is created
    source.close()
    folder.prepare()
    with folder.locked(), folder_errors("the backup could not be written"):
        folder.discard_unfinished()
        at_utc = utc_text((clock or SystemClock()).utc_now())
        name = at_utc.replace(":", "").replace("-", "")
        return _Backup(data_dir, folder, name, at_utc, options, progress or _silent).make()


def _silent(_what: str, _done: int, _total: int) -> None:
    return


@dataclass(frozen=True, slots=True)
class _ReferencedFiles:
    """The files, chains and journal line that the copied database refers to."""

    sizes: dict[str, int]  # sizes of files, by hash
    heads: dict[str, tuple[int, str]]
    root_sha256: str
    line: int  # number of the journal's line


@dataclass(frozen=True, slots=True)
class _Backup:
    data_dir: Path
    folder: BackupFolder
    name: str
    at_utc: str
    options: BackupOptions
    progress: Progress

    def make(self) -> BackupReport:
        part = self.folder.path(self.name + PART)
        self.folder.files.make_directory(part)
        database_sha256 = self._copy_database(part)
        holds, signed = self._read_copy(part)
        journal_sha256 = self._copy_journal(part, holds.line)
        signatures_sha256 = self._copy_signatures(part, signed)
        self._require_same_site(holds)
        missing = self._missing(holds.sizes)
        self._require_space({sha256: holds.sizes[sha256] for sha256 in missing})
        lost = self._copy_files(missing, holds.sizes)
        if self.options.with_keys:
            self._copy_keys(part)
        checked = verification.verify(part, files=False)
        state = BackupState(
            at_utc=self.at_utc,
            host=socket.gethostname(),
            data_folder=str(self.data_dir.resolve()),
            database_sha256=database_sha256,
            signatures_sha256=signatures_sha256,
            journal_sha256=journal_sha256,
            artefacts=len(holds.sizes),
            artefact_bytes=sum(holds.sizes.values()),
            heads=holds.heads,
            root_sha256=holds.root_sha256,
            with_keys=self.options.with_keys,
            faults=(*lost, *(str(fault) for fault in checked.faults)),
        )
        self._publish(part, state)
        copied = [sha256 for sha256 in missing if (self.folder.artefacts.folder / relative_path(sha256)).exists()]
        size = sum(holds.sizes[sha256] for sha256 in copied)
        return BackupReport(self.folder.folder, self.name, state, len(copied), size, len(holds.sizes) - len(missing))

    def _publish(self, part: Path, state: BackupState) -> None:
        """Give the finished state its name, and discard the oldest ones beyond the number to keep."""
        files = self.folder.files
        self._write(part / STATE_FILE, state.model_dump_json(indent=1).encode())
        files.sync_directory(part)
        files.rename(part, self.folder.path(self.name))
        files.sync_directory(part.parent)
        if self.options.keep is not None and not state.faults:
            for old in self.folder.states()[: -max(self.options.keep, 1)]:
                self.folder.discard(self.folder.path(old))

    def _read_copy(self, part: Path) -> tuple[_ReferencedFiles, set[tuple[str, int]]]:
        """Return what the copied database refers to, and the (run, seq) of its signatures."""
        copy = open_read_only(part, self.folder.files)
        try:
            with copy.reading() as connection:
                return _holds(connection), _signed(connection)
        finally:
            copy.close()

    def _copy_database(self, part: Path) -> str:
        """Copy in one step of SQLite's backup, which gives one consistent state. Returns the copy's SHA-256."""
        self.progress("copying the database", 0, 0)
        target = part / DATABASE_NAME
        self.folder.files.write(target, [])  # for whom the folder is; SQLite fills it
        source = open_read_only(self.data_dir, DurableFiles())
        try:
            with source.reading() as connection:
                raw = connection.connection.driver_connection
                assert isinstance(raw, sqlite3.Connection)  # the engine's own driver
                with closing(sqlite3.connect(target, isolation_level=None)) as copy:
                    raw.backup(copy)
                    copy.execute("PRAGMA journal_mode = DELETE")  # a single file that readers do not change
        except sqlite3.Error as error:
            raise StoreError(f"the database could not be copied: {error}", where=str(target), remedy=LOOK) from error
        finally:
            source.close()
        self.folder.files.sync_file(target)
        return hash_file(target)[0]

    def _copy_journal(self, part: Path, line: int) -> str:
        """Copy the journal up to the line that the database copy holds. Returns the copy's SHA-256; "" without lines.

        A journal without the line, or an altered one, is copied as it is, for the audit to find.
        """
        journal = self.data_dir / JOURNAL_NAME
        if not line or not journal.is_file():
            return ""
        self.folder.files.write(part / JOURNAL_NAME, first_lines(journal, line), private=True)
        self.folder.files.sync_file(part / JOURNAL_NAME)
        return hash_file(part / JOURNAL_NAME)[0]

    def _copy_signatures(self, part: Path, copied: set[tuple[str, int]]) -> str:
        """Copy the lines before the first signature newer than the database copy. SHA-256; "" without a log."""
        log = self.data_dir / LOG_NAME
        lines = read_log(log)
        if lines is None:
            return ""
        # A line is newer only if the data folder now holds its signature. A line whose signature is in neither
        # database is evidence of a cut database and is copied, for the audit to find.
        newer = self._signed_now() - copied
        count = len(lines)
        for line in lines:
            if line.checkpoint is not None and (line.checkpoint.run_id, line.checkpoint.seq) in newer:
                count = line.number - 1
                break
        self._write(part / LOG_NAME, b"".join(log.read_bytes().splitlines(keepends=True)[:count]))
        return hash_file(part / LOG_NAME)[0]

    def _signed_now(self) -> set[tuple[str, int]]:
        source = open_read_only(self.data_dir, DurableFiles())
        try:
            with source.reading() as connection:
                return _signed(connection)
        finally:
            source.close()

    def _require_same_site(self, holds: _ReferencedFiles) -> None:
        names = self.folder.states()
        if names and self.folder.read(names[-1]).root_sha256 not in ("", holds.root_sha256):
            raise StoreError(
                "this folder holds the backups of another data folder",
                where=str(self.folder.folder),
                remedy="Give each data folder a folder of its own for its backups",
            )

    def _missing(self, sizes: dict[str, int]) -> list[str]:
        """Return hashes of the files to copy.

        Removes damaged copies, of wrong size or, with `read_all`, wrong content.
        """
        found: list[str] = []
        total, done = sum(sizes.values()), 0
        for sha256, size in sizes.items():
            path = self.folder.artefacts.folder / relative_path(sha256)
            whole = path.is_file() and path.stat().st_size == size
            if whole and self.options.read_all:
                whole = hash_file(path)[0] == sha256
                self.progress("reading earlier copies again", done, total)
            done += size
            if not whole:
                self.folder.files.remove(path)
                found.append(sha256)
        return found

    def _require_space(self, missing: dict[str, int]) -> None:
        needed, free = sum(missing.values()) + _SPARE_BYTES, shutil.disk_usage(self.folder.folder).free
        if needed > free:
            raise StoreError(
                f"the backup needs {gigabytes(needed):.1f} GB more, and {gigabytes(free):.1f} GB are free",
                where=str(self.folder.folder),
                remedy="Make room there, or name a folder on a larger disk; what was copied by then is used again",
            )

    def _copy_files(self, missing: list[str], sizes: dict[str, int]) -> list[str]:
        """Copy files and read them back. Returns the faults of the data folder's own files; they are not errors."""
        lost: list[str] = []
        total, done = sum(sizes[sha256] for sha256 in missing), 0
        for sha256 in missing:
            source = self.data_dir / "artefacts" / relative_path(sha256)
            if fault := self._copy_file(sha256, self._fetched(sha256, source)):
                lost.append(fault)
            done += sizes[sha256]
            self.progress("copying files", done, total)
        # Also for files of earlier backups: the process that renamed them may have died before syncing.
        for shard in {relative_path(sha256).parent for sha256 in sizes}:
            if (self.folder.artefacts.folder / shard).is_dir():
                self.folder.files.sync_directory(self.folder.artefacts.folder / shard)
        return lost

    def _fetched(self, sha256: str, source: Path) -> Path:
        """Return a file of the data folder, or as it is fetched if only the site's object store has it."""
        if source.exists():
            return source
        own = ArtefactFiles(self.data_dir / "artefacts", DurableFiles(), RandomIds())
        with suppress(StoreError):  # then it is missing, as the copying will say
            return SpoolReader(self.data_dir, own).path(sha256)
        return source

    def _copy_file(self, sha256: str, source: Path) -> str:
        try:
            self.folder.artefacts.put(chunks_of(source), expected_sha256=sha256)
        except StoreError:
            fault = _fault_of(source, sha256)
            if not fault:
                raise
            return fault
        self.folder.artefacts.verified_path(sha256)
        return ""

    def _copy_keys(self, part: Path) -> None:
        names = [f"{key_id}.pem" for key_id in KeyFolder(self.data_dir, self.folder.files).present()]
        peppers = [path.name for path in (self.data_dir / KEYS).glob(PEPPER)]
        copy_keys(self.data_dir / KEYS, part / KEYS, self.folder.files, only=[*names, *peppers])

    def _write(self, path: Path, content: bytes) -> None:
        self.folder.files.write(path, [content])
        self.folder.files.sync_file(path)
        if path.read_bytes() != content:
            raise IntegrityError(
                "what was written does not read back as it was",
                where=str(path),
                remedy="The medium cannot be trusted: use another one",
            )


def _fault_of(source: Path, sha256: str) -> str:
    """Return what is wrong with a file of the data folder; "" if nothing is."""
    shown = f"artefacts/{relative_path(sha256)}"
    try:
        return "" if hash_file(source)[0] == sha256 else f"{shown}: the file was altered; it is not in the backup"
    except FileNotFoundError:
        return f"{shown}: the file is missing"
    except OSError as error:
        return f"{shown}: the file cannot be read ({error.strerror}); it is not in the backup"


def _holds(connection: Connection) -> _ReferencedFiles:
    named = select(artefacts.c.sha256, artefacts.c.size_bytes).distinct().order_by(artefacts.c.sha256)
    first = select(event_index.c.run_id).order_by(event_index.c.position).limit(1).scalar_subquery()
    return _ReferencedFiles(
        sizes={row.sha256: row.size_bytes for row in connection.execute(named)},
        heads={row.run_id: (row.seq, row.sha256) for row in connection.execute(select(heads))},
        root_sha256=connection.execute(select(runs.c.root_sha256).where(runs.c.run_id == first)).scalar() or "",
        line=connection.exec_driver_sql("PRAGMA user_version").scalar_one(),
    )


def _signed(connection: Connection) -> set[tuple[str, int]]:
    return {(item.run_id, item.seq) for item in read_every_checkpoint(connection)}
