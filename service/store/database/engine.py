"""The SQLite database of a data folder: opening, migrating, and the two kinds of transaction."""

from __future__ import annotations

import logging
import os
import sqlite3
import time
from collections import OrderedDict
from collections.abc import Generator, Mapping
from contextlib import closing, contextmanager, suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import quote

from sqlalchemy import Connection, Engine, RootTransaction, create_engine, event, text
from sqlalchemy.exc import DBAPIError, SQLAlchemyError
from sqlalchemy.pool import ConnectionPoolEntry
from sqlalchemy.util import LRUCache

from service.core.errors import StoreError
from service.store.data_folder import file_mode, open_new, require_access
from service.store.database import new_schema
from service.store.database.database import (
    PATIENCE_S,
    REVISIONS,
    Database,
    migrate,
    refuse_foreign,
    refuse_newer,
    revision_of,
)
from service.store.durable_effects import Files
from service.store.journal import (
    REBUILD,
    Journal,
    RowImage,
    Tail,
    changed_rows,
    every_row,
    forget_changes,
    watch_changes,
)
from service.store.records import RecordDamagedError, StoreVersionError

DATABASE_NAME = "orthocapture.sqlite"
BUSY_TIMEOUT_S = 30.0  # how long SQLite waits for another process that writes; then a warning is logged
_log = logging.getLogger(__name__)
RESTORE = (
    "`orthocapture store rebuild` restores a damaged database from its journal; or restore the folder from a copy"
)
LOOK = "Look at the disk of the data folder: room, cable, permissions; then resume the run. What was recorded is safe"
_EVENT = "SELECT 1 FROM events WHERE run_id = ? AND seq = ? AND sha256 = ?"
_SHORTER = "SELECT run_id FROM heads WHERE seq <> (SELECT count(*) FROM events WHERE events.run_id = heads.run_id)"
_WRITING = ["journal_mode = WAL", "synchronous = FULL", "temp_store = MEMORY"]  # notes of changes stay in memory
_LOOK_EVERY_S = 1.0
_ENDS_KEPT = 20  # chains whose last event is looked for
_ONLY_NOW = ("SQLITE_BUSY", "SQLITE_LOCKED", "SQLITE_CANTOPEN", "SQLITE_NOMEM", "SQLITE_INTERRUPT")


def database_path(data_dir: Path) -> Path:
    """Return the path of a data folder's database."""
    return data_dir / DATABASE_NAME


def read_schema(connection: Connection) -> dict[tuple[str, str], tuple[str, str | None]]:
    """Return the schema of this database in the format of `fresh_schema`: (type, name) → (table, SQL)."""
    made = connection.execute(text("SELECT type, name, tbl_name, sql FROM sqlite_master"))
    return {(str(row.type), str(row.name)): (str(row.tbl_name), row.sql) for row in made}


@cache
def fresh_schema() -> Mapping[tuple[str, str], tuple[str, str | None]]:
    """Return the schema of a new database of this version: (type such as table or index, name) → (table, SQL)."""
    engine = create_engine("sqlite://")
    try:
        with engine.begin() as connection:
            _upgrade(connection, Path(":memory:"))
            return read_schema(connection)
    finally:
        engine.dispose()


class _Compiled(LRUCache[Any, Any]):
    """Statements as they were compiled for SQLite, for all databases: SQLAlchemy keeps them for each alone."""

    def get(self, key: Any, default: Any = None) -> Any:
        _dialect, *statement = key
        return super().get(tuple(statement), default)

    def __setitem__(self, key: Any, value: Any) -> None:
        _dialect, *statement = key
        super().__setitem__(tuple(statement), value)


_COMPILED = _Compiled(500)


class SqliteDatabase(Database):
    """Connections to one database. Writers use BEGIN IMMEDIATE, so no transaction must be upgraded and retried."""

    def __init__(
        self,
        engine: Engine,
        path: Path,
        files: Files,
        patience_s: float = PATIENCE_S,
        journal: Journal | None = None,
        copy: TemporaryDirectory[str] | None = None,
    ) -> None:
        self._engine = engine
        self._copy = copy  # the folder of a copy that goes with this object
        self._patience_s = patience_s
        self._path = path
        self.where = str(path)
        self._files = files
        self._journal = journal
        self._opened: dict[Path, tuple[int, int]] = {}  # device and inode of the files written to
        self._ends: OrderedDict[str, tuple[int, str]] = OrderedDict()  # chain → its last event written here
        self._looked_at: tuple[int, int] | None = None  # the file's time of change and size at the last look
        self._looked_s = 0.0  # when it was looked at closely

    @contextmanager
    def reading(self) -> Generator[Connection]:
        """Yield a read transaction: one consistent snapshot. Raises StoreError."""
        with _store_errors(self._path), self._engine.connect() as connection, connection.begin():
            yield connection

    @contextmanager
    def writing(self) -> Generator[Connection]:
        """Yield a write transaction: commits through `Files` at the end, rolls back on any exception.

        What it changes is in the journal before it is committed. Nothing is committed, and so nothing is signed,
        unless what was recorded before is still there.

        Raises:
            RecordDamagedError: database and journal do not agree any more, or what was recorded before is gone.
            StoreError: the database refused.
        """
        with _store_errors(self._path), self._engine.connect() as plain:
            connection = plain.execution_options(writes=True)
            raw = self._watched(plain)
            with self._begun(connection) as transaction:
                if raw is not None:
                    forget_changes(raw)
                yield connection
                self.require_in_place()
                if raw is None:
                    self._files.commit(transaction.commit)
                else:
                    self._commit(raw, transaction)

    def _watched(self, connection: Connection) -> sqlite3.Connection | None:
        """Return the driver's connection, whose changes are noted; None without a journal or before tables exist."""
        raw = connection.connection.driver_connection
        assert isinstance(raw, sqlite3.Connection)  # the engine's own driver
        if self._journal is None:
            return None
        if not connection.info.get("watched"):
            connection.info["watched"] = watch_changes(raw)
        return raw if connection.info["watched"] else None

    def _commit(self, raw: sqlite3.Connection, transaction: RootTransaction) -> None:
        """Write the changes to the journal, then commit them, then say in the journal that this was done."""
        rows = changed_rows(raw)
        held = self._require_record(signs=any(row.table == "checkpoints" for row in rows))
        line = self._write_first(raw, rows, held) if rows else None
        try:
            self._files.commit(transaction.commit)
        except Exception:
            if line is not None and self._journal is not None:
                self._journal.mark(line, "withdrawn")
            raise
        if line is not None and self._journal is not None:
            self._journal.mark(line, "committed")
        for row in rows:
            if row.table == "events":
                run_id, seq, sha256 = (row.values[name] for name in ("run_id", "seq", "sha256"))
                self._ends[str(run_id)] = int(seq or 0), str(sha256)
                self._ends.move_to_end(str(run_id))
        while len(self._ends) > _ENDS_KEPT:
            self._ends.popitem(last=False)

    def _write_first(self, raw: sqlite3.Connection, rows: list[RowImage], held: int) -> Tail:
        assert self._journal is not None
        if held:
            line = self._journal.append(rows, held)
        else:
            (events,) = raw.execute("SELECT count(*) FROM events").fetchone()
            earlier = events - sum(row.table == "events" for row in rows)
            line = self._journal.begin(every_row(raw), earlier)
        raw.execute(f"PRAGMA user_version = {line.number}")
        return line

    def require_record(self) -> None:
        """Raise RecordDamagedError unless what was recorded is still there: for whoever does not write just now."""
        with _store_errors(self._path):
            self.require_in_place()
            if self._journal is not None:
                before = self._journal.tail()  # another process may write between the two
                held = self._looked_up(closely=True)
                self._journal.require_not_behind(before, held)
                self._journal.require_not_cut(self._journal.tail(), held)

    def _require_record(self, *, signs: bool) -> int:
        """Return the number of the journal's line that the database holds.

        Raises RecordDamagedError unless both agree. The caller holds the write lock. What is signed
        is looked at closely, and so is a write once a second.
        """
        assert self._journal is not None
        held, tail = self._looked_up(closely=signs), self._journal.tail()
        self._journal.require_not_behind(tail, held)
        self._journal.require_not_cut(tail, held)
        return held

    def _looked_up(self, *, closely: bool) -> int:
        """Return the number of the journal's line that the database holds, as a new connection finds it.

        This one reads pages of the file that other connections only remember, and each commit writes the number.
        Looked at closely, the last events that were written here must still be there, too. If the file itself has
        changed, by SQLite or by somebody else, all of it must fit together.
        """
        address = f"file:{quote(str(self._path.absolute()))}?mode=ro"
        status = self._path.stat()
        now = status.st_mtime_ns, status.st_size
        if not status.st_size:  # SQLite would take it for a new database and delete the write-ahead log
            raise RecordDamagedError(
                "the database was cut to nothing in place; nothing is written any more",
                where=str(self._path),
                remedy=REBUILD,
            )
        try:
            with closing(sqlite3.connect(address, uri=True, timeout=BUSY_TIMEOUT_S, isolation_level=None)) as fresh:
                (held,) = fresh.execute("PRAGMA user_version").fetchone()
                changed = self._looked_at != now
                due = time.monotonic() - self._looked_s >= _LOOK_EVERY_S
                lost = self._missing(fresh, changed=changed) if closely or changed or due else []
        except sqlite3.Error as error:
            if getattr(error, "sqlite_errorname", "").startswith(_ONLY_NOW):
                raise
            raise RecordDamagedError(
                f"the database was overwritten or cut in place ({error}); nothing is written any more",
                where=str(self._path),
                remedy=REBUILD,
            ) from error
        if lost:
            raise RecordDamagedError(
                f"events of {lost[0]} that were recorded are no longer in the database: it was overwritten, cut or "
                "replaced; nothing is written any more",
                where=str(self._path),
                remedy=REBUILD,
            )
        self._looked_at = now
        return int(held)

    def _missing(self, fresh: sqlite3.Connection, *, changed: bool) -> list[str]:
        """Return chains whose last event is gone; if the file has `changed`, also those that lost any other event.

        Raises sqlite3.DatabaseError if the changed file does not fit together, as an older one under a newer log.
        """
        self._looked_s = time.monotonic()
        ends = [(run, *end) for run, end in self._ends.items()]
        gone = [end[0] for end in ends if fresh.execute(_EVENT, end).fetchone() is None]
        if gone or not changed or self._looked_at is None:  # None: just opened, perhaps without tables
            return gone
        (found,) = fresh.execute("PRAGMA quick_check(1)").fetchone()
        if found != "ok":
            raise sqlite3.DatabaseError(str(found).replace("\n", " "))
        return [str(row[0]) for row in fresh.execute(_SHORTER)]

    def _begun(self, connection: Connection) -> RootTransaction:
        """Begin a write transaction as soon as no other process writes."""
        began_s = time.monotonic()
        while True:
            try:
                return connection.begin()
            except DBAPIError as error:
                waited_s = time.monotonic() - began_s
                if not _is_busy(error) or waited_s >= self._patience_s:
                    raise
                _log.warning("another process has held %s for %.0f s; waiting for it", self._path, waited_s)

    def require_in_place(self) -> None:
        """Raise StoreError unless the database and its write-ahead log are still the files that were opened.

        SQLite would go on writing to files that were moved or deleted, and the data would be lost. SQLite itself does
        not remove the log while this process has a connection.
        """
        for path in (self._path, self._path.with_name(self._path.name + "-wal")):
            try:
                found = path.stat()
            except FileNotFoundError:
                found = None
            place = None if found is None else (found.st_dev, found.st_ino)
            opened = self._opened.setdefault(path, place) if place is not None else self._opened.get(path)
            if place is None or place != opened:
                raise StoreError(
                    f"{path.name} was {'removed' if place is None else 'replaced'} while it was in use; nothing is "
                    "written any more",
                    where=str(path),
                    remedy="Put the file back as it was, with those of the same name beside it; or stop every "
                    "orthocapture process of this data folder and run `orthocapture store rebuild`. Then resume the "
                    "run; nothing that was captured is lost",
                )

    def close(self) -> None:
        """Close all connections."""
        self._engine.dispose()
        if self._copy is not None:
            self._copy.cleanup()


def open_database(data_dir: Path, files: Files, patience_s: float = PATIENCE_S) -> SqliteDatabase:
    """Open for writing, creating or upgrading the database. A write waits up to about `patience_s` for others.

    Raises:
        StoreVersionError: a newer version wrote the database.
        RecordDamagedError: it is not the one that the journal describes.
    """
    path = database_path(data_dir)
    journal = Journal(data_dir, files)
    _require_what_the_journal_has(path, journal)
    with _store_errors(path), suppress(FileExistsError):
        # SQLite gives its other files the same mode. A database that exists must not even be opened here: closing it
        # would release the locks that SQLite holds on it in this process (POSIX).
        os.close(open_new(path, os.O_EXCL | os.O_RDONLY, file_mode(data_dir)))
    engine = _engine(f"file:{quote(str(path.absolute()))}?uri=true", writable=True)
    database = SqliteDatabase(engine, path, files, patience_s, journal)
    try:
        with database.reading() as connection:
            is_current = revision_of(connection) == REVISIONS[-1]
        if not is_current:
            with database.writing() as connection:
                _upgrade(connection, path)
        database.require_record()
        files.sync_directory(data_dir)
    except BaseException:
        database.close()
        raise
    return database


def _require_what_the_journal_has(path: Path, journal: Journal) -> None:
    """Raise RecordDamagedError if there is a journal and an empty database, or none: a new one would replace it."""
    there = path.stat().st_size if path.is_file() else 0
    tail = journal.tail()
    if there == 0 and tail is not None and (tail.after or tail.word == "committed"):
        raise RecordDamagedError(
            "the database is empty" if path.is_file() else "the database is gone",
            where=str(path),
            remedy=REBUILD,
        )


def open_read_only(data_dir: Path, files: Files) -> SqliteDatabase:
    """Open an existing database read-only; one of an earlier version as an upgraded copy, which is gone when closed.

    Raises StoreError if there is none, StoreVersionError if it is of a newer version or not of this software.
    """
    path = database_path(data_dir)
    require_access(data_dir)
    if not path.is_file():
        raise StoreError(
            "there is no run data here",
            where=str(path),
            remedy="Name the data folder with --data DIR, or with the environment variable ORTHOCAPTURE_DATA",
        )
    address = f"file:{quote(str(path.absolute()))}?uri=true&mode=ro"
    try:
        return _checked_read_only(_engine(address, writable=False), path, files)
    except StoreVersionError:
        raise
    except StoreError:
        # On read-only media SQLite cannot make its shared-memory file; nobody can be writing there either.
        if path.with_name(path.name + "-wal").exists():
            raise
        return _checked_read_only(_engine(f"{address}&immutable=1", writable=False), path, files)


def _checked_read_only(engine: Engine, path: Path, files: Files) -> SqliteDatabase:
    database = SqliteDatabase(engine, path, files)
    try:
        with database.reading() as connection:
            present = revision_of(connection)
            refuse_newer(present, str(path))
            _refuse_foreign(present, path)
        return database if present == REVISIONS[-1] else _upgraded_copy(database, path, files)
    except BaseException:
        database.close()
        raise


def _upgraded_copy(database: SqliteDatabase, path: Path, files: Files) -> SqliteDatabase:
    """Return a temporary copy of a database of an earlier version, upgraded; the database itself stays as it is."""
    folder = TemporaryDirectory(prefix="orthocapture-")
    copy = Path(folder.name) / DATABASE_NAME
    try:
        with _store_errors(path), database.reading() as connection, closing(sqlite3.connect(copy)) as target:
            raw = connection.connection.driver_connection
            assert isinstance(raw, sqlite3.Connection)  # the engine's own driver
            raw.backup(target)
        engine = create_engine(f"sqlite:///{copy}")
        with _store_errors(path), engine.begin() as connection:
            migrate(connection)
        engine.dispose()
    except BaseException:
        folder.cleanup()
        raise
    database.close()
    upgraded = _engine(f"file:{quote(str(copy))}?uri=true&mode=ro", writable=False)
    return SqliteDatabase(upgraded, path, files, copy=folder)


def _engine(address: str, *, writable: bool) -> Engine:
    engine = create_engine(
        f"sqlite:///{address}",
        connect_args={"timeout": BUSY_TIMEOUT_S},
        execution_options={"compiled_cache": _COMPILED},
    )

    def on_connect(connection: sqlite3.Connection, _record: ConnectionPoolEntry) -> None:
        # The driver's own BEGIN comes too late and is never IMMEDIATE, so on_begin below sends it.
        connection.isolation_level = None
        pragmas = ["foreign_keys = ON", "recursive_triggers = ON"]
        pragmas += _WRITING if writable else ["query_only = ON"]
        try:
            for pragma in pragmas:
                connection.execute(f"PRAGMA {pragma}")
        except sqlite3.Error:  # not a database, or damaged; the pool does not know this connection yet
            connection.close()
            raise

    def on_begin(connection: Connection) -> None:
        if connection.get_execution_options().get("writes", False):
            connection.exec_driver_sql("BEGIN IMMEDIATE")
        else:  # by the driver itself, which takes a tenth of the time: pages read many times
            connection.connection.cursor().execute("BEGIN")

    event.listen(engine, "connect", on_connect)
    event.listen(engine, "begin", on_begin)
    return engine


def _refuse_foreign(present: str | None, path: Path) -> None:
    if present is None:
        raise StoreVersionError(
            "this is not a database of orthocapture", where=str(path), remedy="Name a data folder with --data DIR"
        )


def _upgrade(connection: Connection, path: Path) -> None:
    present = revision_of(connection)
    refuse_newer(present, str(path))
    if present is not None:
        if present != REVISIONS[-1]:
            migrate(connection)
        return
    refuse_foreign(connection, str(path), "Choose another data folder")
    for statement in new_schema.STATEMENTS:
        connection.exec_driver_sql(statement)
    connection.execute(text("INSERT INTO alembic_version VALUES (:revision)"), {"revision": REVISIONS[-1]})


@contextmanager
def _store_errors(path: Path) -> Generator[None]:
    try:
        yield
    except DBAPIError as error:
        raise StoreError(_explain(error), where=str(path), remedy=_advise(error)) from error
    except sqlite3.Error as error:
        raise StoreError(f"the database refused: {error}", where=str(path), remedy=LOOK) from error
    except UnicodeDecodeError as error:  # raised by the driver for damaged text
        raise StoreError(
            "the database is damaged: it holds text that is not UTF-8", where=str(path), remedy=RESTORE
        ) from error
    except SQLAlchemyError as error:
        raise StoreError(f"the database refused: {error}", where=str(path), remedy=LOOK) from error
    except OSError as error:
        raise StoreError(
            f"the data folder refused: {error.strerror or error}", where=str(error.filename or path), remedy=LOOK
        ) from error


def _explain(error: DBAPIError) -> str:
    return f"the database refused: {error.orig}"


def _is_busy(error: DBAPIError) -> bool:
    return str(getattr(error.orig, "sqlite_errorname", "")).startswith("SQLITE_BUSY")


def _advise(error: DBAPIError) -> str:
    code: Any = getattr(error.orig, "sqlite_errorname", "")
    return {
        "SQLITE_IOERR_SHORT_READ": RESTORE,
        "SQLITE_BUSY": "Another process has held the database for too long; look for one that hangs",
        "SQLITE_FULL": "Free space on this disk; what was recorded before is safe",
        "SQLITE_CORRUPT": RESTORE,
        "SQLITE_NOTADB": RESTORE,
        "SQLITE_READONLY": "Check the permissions of the data folder",
        "SQLITE_CANTOPEN": "Check that the data folder exists and its permissions",
    }.get(str(code), LOOK)
