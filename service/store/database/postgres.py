"""The PostgreSQL database of a site: its tables and rights, opening, preparing, and the two kinds of transaction.

Two roles: the owner of the tables prepares and upgrades them and is used for nothing else; the role of the program
may read and insert evidence, and change only what is of the moment. Writers wait for one another (an advisory lock
that ends with the transaction), so that a chain has one end and positions follow the order of commits.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Engine, TextClause, create_engine, event, text
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError, DBAPIError, NoSuchModuleError, SQLAlchemyError
from sqlalchemy.pool import ConnectionPoolEntry

from service.core.errors import ConfigurationError, StoreError
from service.store.database.database import (
    PATIENCE_S,
    REVISIONS,
    Database,
    migrate,
    postgres_triggers,
    refuse_foreign,
    refuse_newer,
    revision_of,
)
from service.store.database.tables import metadata
from service.store.durable_effects import DurableFiles, Files
from service.store.records import StoreVersionError

EVIDENCE = ("runs", "events", "artefacts", "checkpoints", "timestamps", "event_index", "event_facets", "event_words")
_ENDS = ("heads",)  # inserted and moved, never removed
_OF_THE_MOMENT = ("jobs", "leases", "accounts", "invitations", "sessions", "control", "copies")
_REFUSAL = """
BEGIN
  RAISE EXCEPTION '% is append-only: % refused', TG_TABLE_NAME, lower(TG_OP);
END """
_REFUSE = f"CREATE FUNCTION refuse_change() RETURNS trigger LANGUAGE plpgsql AS $${_REFUSAL}$$"
_FURTHER = (
    "CREATE TABLE alembic_version (version_num VARCHAR(32) NOT NULL PRIMARY KEY)",
    "CREATE TABLE event_words (position BIGINT NOT NULL PRIMARY KEY, words TSVECTOR NOT NULL)",
    "CREATE INDEX event_words_by_word ON event_words USING gin (words)",
    # The order of signatures; SQLite counts rows by itself, under this name.
    "ALTER TABLE checkpoints ADD COLUMN rowid BIGINT GENERATED ALWAYS AS IDENTITY",
    # The row of a run holds the hash of its first event, which refers to the row.
    "ALTER TABLE events ALTER CONSTRAINT events_run_id_fkey DEFERRABLE INITIALLY IMMEDIATE",
    "ALTER TABLE heads ALTER CONSTRAINT heads_run_id_fkey DEFERRABLE INITIALLY IMMEDIATE",
    _REFUSE.replace("%", "%%"),
)
# What these tables have beside the columns and constraints of service.store.database.tables.
FURTHER_COLUMNS: Mapping[tuple[str, str], object] = {
    ("alembic_version", "version_num"): ("character varying(32)", True),
    ("checkpoints", "rowid"): ("bigint", True),
    ("event_words", "position"): ("bigint", True),
    ("event_words", "words"): ("tsvector", True),
}
FURTHER_CONSTRAINTS = {("alembic_version", "alembic_version_pkey"), ("event_words", "event_words_pkey")}
_EVERY_ROW = 1 + 2 + 8 + 16  # of pg_trigger.tgtype: for each row, before, delete, update
_EVERY_TRUNCATE = 2 + 32  # before, truncate


def triggers() -> dict[tuple[str, str], object]:
    """Return by table and name how each trigger is enabled, its type as in pg_trigger, and what it does."""
    found: dict[tuple[str, str], object] = {}
    for table in EVIDENCE:
        found[table, f"{table}_append_only"] = ("O", _EVERY_ROW, _REFUSAL)
        found[table, f"{table}_no_truncate"] = ("O", _EVERY_TRUNCATE, _REFUSAL)
    return found


def granted(table: str) -> tuple[str, ...]:
    """Return what the program's role may do with a table."""
    if table in EVIDENCE:
        return ("SELECT", "INSERT")
    if table in _ENDS:
        return ("SELECT", "INSERT", "UPDATE")
    return ("SELECT", "INSERT", "UPDATE", "DELETE") if table in _OF_THE_MOMENT else ("SELECT",)


def make_tables(connection: Connection) -> None:
    """Make all tables as their owner: the same that the migrations make of the tables of an earlier version."""
    metadata.create_all(connection)
    for statement in (*_FURTHER, *(made for table in EVIDENCE for made in postgres_triggers(table))):
        connection.exec_driver_sql(statement)
    connection.execute(text("INSERT INTO alembic_version VALUES (:revision)"), {"revision": REVISIONS[-1]})


def grant_rights(connection: Connection, role: str) -> tuple[str, ...]:
    """Grant a role the missing privileges, as the owner of the tables; return them, one text a table."""
    done: list[str] = []
    asked = text("SELECT has_table_privilege(:role, :table, :power)")
    for table in ("alembic_version", *EVIDENCE, *_ENDS, *_OF_THE_MOMENT):
        missing = [
            power
            for power in granted(table)
            if not connection.execute(asked, {"role": role, "table": table, "power": power}).scalar_one()
        ]
        if missing:
            connection.exec_driver_sql(f"GRANT {', '.join(missing)} ON {table} TO {_quoted(role)}")
            done.append(f"{', '.join(missing)} on {table}")
    return tuple(done)


def _quoted(role: str) -> str:
    return '"' + role.replace("%", "%%").replace('"', '""') + '"'


_log = logging.getLogger(__name__)
WRITERS = 0x6F727468  # the advisory lock that writers hold; any number that nobody else uses
LOCK_TIMEOUT_S = 30  # of one wait for another writer; then a warning is logged
_HUNG_S = 120  # a client that does nothing within a transaction for so long loses it, so that a site goes on
_AGAIN_S = 0.5
_LOCK_NOT_AVAILABLE, _DEADLOCK = "55P03", "40P01"
_COMMITTED, _ABORTED = "committed", "aborted"
_NUMBER = text("SELECT txid_current(), NULL")
# Asked once the writer is alone, and so after any upgrade for which it has waited.
_NUMBER_AND_REVISION = text("SELECT txid_current(), (SELECT version_num FROM alembic_version)")
LOOK = "Look at the database server: does it run, can this machine reach it, has it room? What was recorded is safe"

LOOK_HERE = "Look at the disk of the data folder: room, cable, permissions. What was recorded is safe"
HUNG = "Another process has held the database for too long; look for one that hangs"


def engine_for(url: str) -> Engine:
    """Return an engine for the address of a PostgreSQL database. Raises StoreError, ConfigurationError."""
    try:
        address = make_url(url).set(drivername="postgresql+psycopg")
        options = f"-c lock_timeout={LOCK_TIMEOUT_S}s -c idle_in_transaction_session_timeout={_HUNG_S}s"
        return create_engine(address, connect_args={"options": options, "connect_timeout": 10}, pool_pre_ping=True)
    except (ArgumentError, NoSuchModuleError) as error:
        raise StoreError(
            f"this is not the address of a database: {error}",
            remedy="Write postgresql://USER@HOST/DATABASE; the password belongs into ~/.pgpass or PGPASSWORD",
        ) from error
    except ModuleNotFoundError as error:
        raise ConfigurationError(
            "PostgreSQL is used with the package psycopg, which is not installed",
            remedy='Install it: python -m pip install "orthocapture[site]"',
        ) from error


class PostgresDatabase(Database):
    """Connections of the program's role to one PostgreSQL database."""

    def __init__(self, engine: Engine, files: Files, patience_s: float = PATIENCE_S) -> None:
        self._engine = engine
        self._files = files
        self._patience_s = patience_s
        self.where = engine.url.render_as_string(hide_password=True)

    @contextmanager
    def reading(self) -> Generator[Connection]:
        """Yield a read transaction: one consistent snapshot. Raises StoreError."""
        with _store_errors(self.where), self._engine.connect() as plain:
            connection = plain.execution_options(isolation_level="REPEATABLE READ", postgresql_readonly=True)
            with connection.begin():
                yield connection

    @contextmanager
    def writing(self) -> Generator[Connection]:
        """Yield a write transaction: commits at the end, rolls back on any exception.

        Raises:
            StoreVersionError: the database was upgraded since this program opened it; nothing was written.
            StoreError: the database refused.
        """
        with self._alone(_NUMBER_AND_REVISION) as connection:
            yield connection

    @contextmanager
    def preparing(self) -> Generator[Connection]:
        """Yield a write transaction in which tables may be made or changed; as `writing`, whatever the revision."""
        with self._alone(_NUMBER) as connection:
            yield connection

    @contextmanager
    def _alone(self, asked: TextClause) -> Generator[Connection]:
        with _store_errors(self.where), self._engine.connect() as connection:
            self._begin(connection)
            transaction = connection.get_transaction()
            assert transaction is not None  # the first statement has begun it
            try:
                number, revision = connection.execute(asked).one()
                if revision is not None:
                    _require_current(revision, self.where)
                yield connection
            except BaseException:
                if not connection.invalidated:
                    transaction.rollback()
                raise
            try:
                self._files.commit(transaction.commit)
            except DBAPIError as error:
                if not error.connection_invalidated:
                    raise
                self._require_committed(int(number), error)

    def _begin(self, connection: Connection) -> None:
        """Wait until no other process writes, and keep the others waiting until the transaction ends."""
        began_s = time.monotonic()
        while True:
            try:
                connection.execute(text("SELECT pg_advisory_xact_lock(:writers)"), {"writers": WRITERS})
            except DBAPIError as error:
                connection.rollback()
                waited_s = time.monotonic() - began_s
                if getattr(error.orig, "sqlstate", "") != _LOCK_NOT_AVAILABLE or waited_s >= self._patience_s:
                    raise
                _log.warning("another process has held %s for %.0f s; waiting for it", self.where, waited_s)
            else:
                return

    def _require_committed(self, number: int, lost: DBAPIError) -> None:
        """Ask whether the transaction whose connection was lost at its commit was committed. Raises StoreError."""
        began_s = time.monotonic()
        while True:
            try:
                with self._engine.connect() as connection:
                    asked = text("SELECT txid_status(:number)")
                    status = connection.execute(asked, {"number": number}).scalar_one_or_none()
            except DBAPIError:
                status = None
            if status == _COMMITTED:
                return
            if status == _ABORTED:
                raise StoreError(
                    "the connection to the database was lost, and nothing of this was recorded",
                    where=self.where,
                    remedy=LOOK,
                ) from lost
            if time.monotonic() - began_s >= self._patience_s:
                raise StoreError(
                    "the connection to the database was lost, and whether this was recorded is not known",
                    where=self.where,
                    remedy=f"{LOOK}; then look at the end of the run before you repeat anything",
                ) from lost
            time.sleep(_AGAIN_S)

    def require_in_place(self) -> None:
        """Do nothing: a server keeps its own files."""

    def require_record(self) -> None:
        """Raise StoreError unless the server answers."""
        with self.reading() as connection:
            connection.execute(text("SELECT 1 FROM heads LIMIT 1")).all()

    def listening_engine(self) -> Engine | None:
        """Return the engine, from which a connection is taken for good."""
        return self._engine

    def close(self) -> None:
        """Close all connections; one that a thread still uses as soon as it gives it back."""
        event.listen(self._engine, "checkin", _close_now)
        self._engine.dispose()


def _close_now(_connection: object, record: ConnectionPoolEntry) -> None:
    record.invalidate()


def open_postgres(url: str, files: Files, patience_s: float = PATIENCE_S) -> PostgresDatabase:
    """Open the prepared database of a site as the program's role.

    Raises:
        StoreVersionError: another version prepared it, or nobody did.
        StoreError: it cannot be reached, or the role owns the tables and so could change the evidence.
    """
    database = PostgresDatabase(engine_for(url), files, patience_s)
    try:
        with database.reading() as connection:
            require_prepared(connection, database.where)
            require_no_owner(connection, database.where)
    except BaseException:
        database.close()
        raise
    return database


def require_prepared(connection: Connection, where: str) -> None:
    """Raise StoreVersionError unless this version's tables are there."""
    present = revision_of(connection)
    if present is None:
        raise StoreVersionError(
            "this database has not been prepared",
            where=where,
            remedy="Prepare it as its owner: orthocapture store prepare URL-OF-THE-OWNER --role ROLE",
        )
    _require_current(present, where)


def _require_current(present: str, where: str) -> None:
    refuse_newer(present, where)
    if present != REVISIONS[-1]:
        raise StoreVersionError(
            f"this database was prepared by an earlier version of orthocapture (its revision is {present}, and this "
            f"version's {REVISIONS[-1]})",
            where=where,
            remedy="End the programs of the site, back up, and upgrade it as its owner: orthocapture store prepare "
            "URL-OF-THE-OWNER --role ROLE",
        )


def require_no_owner(connection: Connection, where: str) -> None:
    """Raise StoreError if this role may change evidence: it owns tables, is a superuser, or was granted too much."""
    powers = powers_over_evidence(connection)
    if powers:
        role = connection.execute(text("SELECT current_user")).scalar_one()
        raise StoreError(
            f"the role {role} {powers[0]}: it could change the evidence",
            where=where,
            remedy="Connect as a role that does not own the tables; `orthocapture store prepare --role` grants one",
        )


def powers_over_evidence(connection: Connection) -> list[str]:
    """Return what this role may do that would change evidence; empty if it may only read and insert it."""
    found: list[str] = []
    if connection.execute(text("SELECT rolsuper FROM pg_roles WHERE rolname = current_user")).scalar_one():
        found.append("is a superuser")
    for table in EVIDENCE:
        owner = text("SELECT pg_has_role(relowner, 'USAGE') FROM pg_class WHERE oid = to_regclass(:name)")
        if connection.execute(owner, {"name": table}).scalar():
            found.append(f"owns the table {table}")
        for power in ("UPDATE", "DELETE", "TRUNCATE", "TRIGGER"):
            may = text("SELECT has_table_privilege(current_user, :name, :power)")
            if connection.execute(may, {"name": table, "power": power}).scalar():
                found.append(f"may {power} on {table}")
    return found


@contextmanager
def _store_errors(where: str) -> Generator[None]:
    try:
        yield
    except DBAPIError as error:
        late = getattr(error.orig, "sqlstate", "") in (_LOCK_NOT_AVAILABLE, _DEADLOCK)
        raise StoreError(
            f"the database refused: {_first_line(error.orig)}", where=where, remedy=HUNG if late else LOOK
        ) from error
    except SQLAlchemyError as error:
        raise StoreError(f"the database refused: {error}", where=where, remedy=LOOK) from error
    except OSError as error:  # of files that are written within a transaction, such as keys
        raise StoreError(
            f"the data folder refused: {error.strerror or error}",
            where=str(error.filename or where),
            remedy=LOOK_HERE,
        ) from error


def _first_line(error: Any) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


_AS_OWNER = "Name the owner in the address, postgresql://OWNER@HOST/DATABASE; nothing was changed"


@dataclass(frozen=True, slots=True)
class Prepared:
    """The result of preparing a database."""

    before: str | None  # the revision before; None: it was empty
    revision: str
    granted: tuple[str, ...]  # the missing privileges, such as "SELECT, INSERT on events"


def prepare(owner_url: str, role: str) -> Prepared:
    """Make or upgrade the tables of a site as their owner, and grant the program's role its missing privileges.

    All of it is one transaction, during which no program writes. An interruption leaves the database as it was.

    Raises:
        StoreVersionError: a newer version prepared the database, or it has tables that are not orthocapture's.
        StoreError: it cannot be reached, or its tables belong to another role.
    """
    database = PostgresDatabase(engine_for(owner_url), DurableFiles())
    try:
        with database.preparing() as connection:
            present = revision_of(connection)
            refuse_newer(present, database.where)
            if present is None:
                refuse_foreign(connection, database.where, "Name an empty database; nothing was changed")
                make_tables(connection)
            else:
                _require_owner(connection, database.where)
                if present != REVISIONS[-1]:
                    migrate(connection)
            return Prepared(present, REVISIONS[-1], grant_rights(connection, role))
    finally:
        database.close()


def _require_owner(connection: Connection, where: str) -> None:
    asked = "SELECT pg_get_userbyid(relowner), current_user FROM pg_class WHERE oid = to_regclass('alembic_version')"
    owner, user = connection.execute(text(asked)).one()
    if owner != user:
        what = f"the tables belong to the role {owner}, and this address names {user}"
        raise StoreError(what, where=where, remedy=_AS_OWNER)
