"""Restores a data folder from a backup, and makes a database again from its journal, or the journal from it."""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from urllib.parse import quote

from sqlalchemy import create_engine, delete, select

from service.core.errors import IntegrityError, OrthocaptureError, StoreError
from service.core.records.events import DataRestored, RecordRebuilt
from service.store.artefacts import ArtefactFiles, chunks_of, hash_file, relative_path
from service.store.backup import BackupFolder, BackupState, copy_keys, folder_errors
from service.store.data_folder import KEYS
from service.store.database.engine import DATABASE_NAME, database_path, open_database, open_read_only
from service.store.database.opening import require_sqlite
from service.store.database.tables import artefacts, control, leases, sessions
from service.store.durable_effects import Clock, DurableFiles, Files, RandomIds, SystemClock, utc_text
from service.store.event_index import index_all
from service.store.journal import NAME, Journal, apply_row, every_row, first_lines
from service.store.journal import NAME as JOURNAL_NAME
from service.store.objects.reading import not_elsewhere
from service.store.records import SITE
from service.store.signatures.log import NAME as LOG_NAME
from service.store.signatures.signing import checkpoint
from service.store.store import Store
from service.store.verification import verify as verification
from service.store.verification.file_checks import Survey, committed_rows, journal_findings, survey
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
        report = verification.verify(work, progress=progress)
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


_WORK = "rebuilding"  # within the data folder, until everything in it is complete
_LATEST_HEADS = "INSERT INTO heads (run_id, seq, sha256) SELECT run_id, max(seq), sha256 FROM events GROUP BY run_id"
_MOST_NAMED = 20


@dataclass(frozen=True, slots=True)
class RebuildReport:
    """The result of a rebuild.

    Attributes:
        made: the part that was made again; "" if database and journal agree.
        why: the fault that was found.
        events: number of events in all chains afterwards.
        restored_events: number of these that the old database no longer held.
        kept: files of the data folder that hold what was there before.
        lost: texts on what could not be restored.
        unsigned: the reason why the record of this could not be signed; "" if it was.
    """

    made: Literal["", "database", "journal"]
    why: str = ""
    events: int = 0
    restored_events: int = 0
    kept: tuple[str, ...] = ()
    lost: tuple[str, ...] = ()
    unsigned: str = ""


@dataclass(frozen=True, slots=True)
class _Found:
    """A database as it was found.

    Attributes:
        problem: the reason why it cannot be relied upon; "" if SQLite reads all of it.
        held: number of the journal's line that it holds.
        events: number of events that can be read.
    """

    problem: str
    held: int = 0
    events: int = 0


def rebuild(
    data_dir: Path,
    *,
    actor: Callable[[Path], str],
    journal: Path | None = None,
    files: Files | None = None,
    clock: Clock | None = None,
) -> RebuildReport:
    """Make again what does not agree with the other: the database from the journal, or the journal from the database.

    The journal counts if its lines are as they were written and the database misses one of them, has another row or
    cannot be read; the database counts if all of it can be read and the journal misses what it holds. This is
    recorded in the site's chain, and signed. No process may use the data folder meanwhile; one that does is refused
    its next write.

    Args:
        data_dir: the data folder.
        actor: gives the name of the person for the record, or raises if that is somebody else's; called with a folder
            that has the accounts.
        journal: a copy of the journal from elsewhere, from which the database is made in any case.
        files: durable file operations.
        clock: gives the time for the names of the files that stay.

    Raises:
        StoreError: there is nothing to rebuild from, or the folder cannot be written; nothing was changed.
        OrthocaptureError: raised by `actor`; nothing was changed.
    """
    require_sqlite(data_dir)
    files, clock = files or DurableFiles(), clock or SystemClock()
    stamp = utc_text(clock.utc_now()).replace(":", "").replace("-", "")
    surveyed, found = survey(journal or data_dir / NAME), _look(data_dir)
    behind = bool(found.problem) or surveyed.is_behind(found.held)
    with folder_errors("the record could not be rebuilt"):
        if journal is None and not behind and (surveyed.problems or surveyed.last < max(found.held, 1)):
            return _journal_again(data_dir, surveyed, found, stamp, actor, files, clock)
        why = found.problem or _why(data_dir, surveyed, found)
        if not why and journal is None:
            return RebuildReport("")
        if surveyed.last == 0:
            raise StoreError(
                "there is no journal from which the database could be made again",
                where=str(journal or data_dir / NAME),
                remedy="Name the copy in the second place with --journal, or restore a backup",
            )
        return _database_again(data_dir, journal or data_dir / NAME, surveyed, found, why, stamp, actor, files, clock)


def _look(data_dir: Path) -> _Found:
    path = database_path(data_dir)
    if not path.is_file():
        return _Found("the database is gone")
    try:
        address = f"file:{quote(str(path.absolute()))}?mode=ro"
        with closing(sqlite3.connect(address, uri=True, isolation_level=None)) as connection:
            (held,) = connection.execute("PRAGMA user_version").fetchone()
            (events,) = connection.execute("SELECT count(*) FROM events").fetchone()
            damage = [str(row[0]) for row in connection.execute("PRAGMA integrity_check(3)") if row[0] != "ok"]
    except sqlite3.Error as error:
        return _Found(f"the database cannot be read: {error}")
    return _Found(f"the database is damaged: {damage[0]}" if damage else "", int(held), int(events))


def _why(data_dir: Path, surveyed: Survey, found: _Found) -> str:
    """Return how the database differs from its journal; "" if they agree."""
    if surveyed.is_behind(found.held):
        return f"the database held line {found.held} of the journal, which has {surveyed.last}"
    database = open_read_only(data_dir, DurableFiles())
    try:
        with database.reading() as connection:
            faults, _notes = journal_findings(data_dir, connection, None, lambda: found.held)
    finally:
        database.close()
    return str(faults[0]) if faults else ""


def _journal_again(
    data_dir: Path,
    surveyed: Survey,
    found: _Found,
    stamp: str,
    actor: Callable[[Path], str],
    files: Files,
    clock: Clock,
) -> RebuildReport:
    """Start the journal again with what the database holds."""
    why = (
        f"line {surveyed.problems[0][0]} of the journal: {surveyed.problems[0][1]}"
        if surveyed.problems
        else f"the journal ended at line {surveyed.last}, the database held line {found.held}"
    )
    name = _named_with_a_copy(data_dir, actor, files)
    path, kept = data_dir / NAME, f"{NAME}.before-{stamp}"
    with closing(sqlite3.connect(database_path(data_dir), isolation_level=None)) as connection:
        connection.execute("PRAGMA synchronous = FULL")
        connection.execute("BEGIN IMMEDIATE")
        had_one = path.exists()
        if had_one:
            os.link(path, data_dir / kept)
        journal = Journal(data_dir, files)
        tail = journal.begin(every_row(connection), found.events)
        connection.execute(f"PRAGMA user_version = {tail.number}")
        files.commit(connection.commit)
        journal.mark(tail, "committed")
    made = RecordRebuilt(
        made="journal", why=why, events=found.events, restored_events=0, kept=(kept,) if had_one else ()
    )
    return _record(data_dir, made, name, files, clock)


def _named_with_a_copy(data_dir: Path, actor: Callable[[Path], str], files: Files) -> str:
    """Return the person's name, by the accounts in a copy of the database: the folder itself does not open."""
    with _work_folder(data_dir, files) as work:
        with (
            closing(sqlite3.connect(database_path(data_dir))) as original,
            closing(sqlite3.connect(database_path(work))) as copy,
        ):
            original.backup(copy)
            copy.execute("PRAGMA user_version = 0")  # as of a folder without a journal
        return actor(work)


@contextmanager
def _work_folder(data_dir: Path, files: Files) -> Generator[Path]:
    """Yield a folder within the data folder that has its keys, and is gone afterwards."""
    work = data_dir / _WORK
    shutil.rmtree(work, ignore_errors=True)  # of an interrupted rebuild
    files.make_directory(work, private=True)
    try:
        if (data_dir / KEYS).is_dir():
            (work / KEYS).symlink_to(Path("..") / KEYS)
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _database_again(
    data_dir: Path,
    journal: Path,
    surveyed: Survey,
    found: _Found,
    why: str,
    stamp: str,
    actor: Callable[[Path], str],
    files: Files,
    clock: Clock,
) -> RebuildReport:
    """Make the database again in a folder of its own, then put it in place of the old one, which is renamed."""
    with _work_folder(data_dir, files) as work:
        withdrawn = surveyed.mark is not None and surveyed.mark.word == "withdrawn"
        until = surveyed.before_last if withdrawn else surveyed.last
        lost = [f"line {number} of the journal: {what}" for number, what in surveyed.problems]
        events = _replay(work, journal, surveyed, until, lost)
        files.write(work / NAME, first_lines(journal, until), private=True)
        files.sync_file(work / NAME)
        lost += _missing_files(data_dir, work)
        name = actor(work)
        kept = _put_in_place(data_dir, work, stamp, files)
    made = RecordRebuilt(
        made="database",
        why=why,
        events=events,
        restored_events=max(0, events - (0 if found.problem else found.events)),
        kept=kept,
        lost=tuple(lost),
    )
    return _record(data_dir, made, name, files, clock)


def _replay(work: Path, journal: Path, surveyed: Survey, until: int, lost: list[str]) -> int:
    """Make a database of all rows up to line `until`; returns the number of events. `lost` gets what it refuses."""
    open_database(work, DurableFiles()).close()
    with closing(sqlite3.connect(database_path(work), isolation_level=None)) as connection:
        connection.execute("PRAGMA foreign_keys = OFF")  # checked at the end
        connection.execute("PRAGMA recursive_triggers = ON")
        connection.execute("BEGIN")
        for row in committed_rows(journal, surveyed, until):
            try:
                apply_row(connection, row)
            except sqlite3.Error as error:
                lost.append(f"a row of {row.table}: {error}")
        connection.execute(_LATEST_HEADS)
        connection.execute(f"PRAGMA user_version = {until}")
        connection.execute("COMMIT")
        for table, row_number, parent, _key in connection.execute("PRAGMA foreign_key_check").fetchall():
            lost.append(f"row {row_number} of {table} belongs to a row of {parent} that is not there")
        (events,) = connection.execute("SELECT count(*) FROM events").fetchone()
        connection.execute("PRAGMA journal_mode = DELETE")  # a single file, which can be renamed
    engine = create_engine(f"sqlite:///{database_path(work)}")
    try:
        with engine.begin() as connection:
            index_all(connection)
    finally:
        engine.dispose()
    return int(events)


def _missing_files(data_dir: Path, work: Path) -> Iterator[str]:
    with closing(sqlite3.connect(database_path(work))) as connection:
        named = connection.execute("SELECT DISTINCT sha256, original_name FROM artefacts ORDER BY sha256").fetchall()
    gone = [(sha, name) for sha, name in named if not (data_dir / "artefacts" / relative_path(str(sha))).is_file()]
    if gone:
        lost = set(not_elsewhere(data_dir, [str(sha) for sha, _name in gone]))
        gone = [(sha, name) for sha, name in gone if str(sha) in lost]
    for sha256, name in gone[:_MOST_NAMED]:
        yield f"the file {name} is missing (artefacts/{relative_path(str(sha256))})"
    if len(gone) > _MOST_NAMED:
        yield f"{len(gone) - _MOST_NAMED} more files are missing"


def _put_in_place(data_dir: Path, work: Path, stamp: str, files: Files) -> tuple[str, ...]:
    """Give the old files other names, and the new ones theirs. Returns the names of the old ones.

    A crash in between leaves the journal, from which this can be done again.
    """
    database = database_path(work)
    files.sync_file(database)
    files.sync_file(work / NAME)  # the actor's sign-in may have been added
    kept: list[str] = []
    if (data_dir / NAME).exists():
        kept.append(f"{NAME}.before-{stamp}")
        os.link(data_dir / NAME, data_dir / kept[-1])
    files.rename(work / NAME, data_dir / NAME)
    for suffix in ("-wal", "-shm", ""):
        old = data_dir / f"{DATABASE_NAME}{suffix}"
        if old.exists():
            kept.append(f"{DATABASE_NAME}.before-{stamp}{suffix}")
            files.rename(old, data_dir / kept[-1])
    files.sync_directory(data_dir)
    files.rename(database, database_path(data_dir))
    files.sync_directory(data_dir)
    return tuple(sorted(kept))


def _record(data_dir: Path, made: RecordRebuilt, actor: str, files: Files, clock: Clock) -> RebuildReport:
    with Store.open(data_dir, clock, files=files, create=False) as store:
        store.record_site([made], actor=actor)
        unsigned = ""
        try:
            checkpoint(store, SITE)
        except StoreError as error:
            unsigned = str(error)
    return RebuildReport(made.made, made.why, made.events, made.restored_events, made.kept, made.lost, unsigned)
