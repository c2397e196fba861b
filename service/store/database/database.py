"""What the store asks of its database, SQLite or PostgreSQL: its revisions, and to wait until it changes."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from contextlib import AbstractContextManager, suppress
from typing import Any, Literal

from sqlalchemy import Column, ColumnElement, Connection, DateTime, Double, Engine, cast, extract, func, inspect, text
from sqlalchemy.exc import SQLAlchemyError

from service.store.durable_effects import Clock
from service.store.records import StoreVersionError

PATIENCE_S = 300.0  # for all waits of one write: a process that is starved may hold the database for minutes


def is_postgres(connection: Connection) -> bool:
    """Return whether this is a connection to PostgreSQL."""
    return connection.dialect.name == "postgresql"


def lease_now_s(connection: Connection, clock: Clock) -> float:
    """Return the UTC time in seconds by which leases are judged: the server's, where several hosts share one."""
    if is_postgres(connection):
        return float(connection.execute(text("SELECT extract(epoch FROM clock_timestamp())")).scalar_one())
    return clock.utc_s()


def seconds_between(connection: Connection, begin: Column[str], end: Column[str]) -> ColumnElement[float]:
    """Return the seconds from one recorded UTC time to another, as an expression of the database."""
    if is_postgres(connection):
        taken = cast(end, DateTime(timezone=True)) - cast(begin, DateTime(timezone=True))
        return cast(extract("epoch", taken), Double)
    return (func.julianday(end) - func.julianday(begin)) * 86400


class Database(ABC):
    """Connections to one database, with two kinds of transaction. All methods raise StoreError."""

    where: str  # what errors and records call it: a path, or an address without its password

    @abstractmethod
    def reading(self) -> AbstractContextManager[Connection]:
        """Begin a read transaction: one consistent snapshot."""

    @abstractmethod
    def writing(self) -> AbstractContextManager[Connection]:
        """Begin a write transaction, alone: commits through `Files` at the end, rolls back on any exception."""

    @abstractmethod
    def require_record(self) -> None:
        """Raise RecordDamagedError unless what was recorded is still there: for whoever does not write just now."""

    @abstractmethod
    def require_in_place(self) -> None:
        """Raise StoreError unless the database is still the one that was opened."""

    def listening_engine(self) -> Engine | None:
        """Return what opens connections that hear of changes; None where one can only poll."""
        return None

    @abstractmethod
    def close(self) -> None:
        """Close all connections."""


REVISIONS = ("0001", "0002", "0003", "0004", "0005", "0006", "0007")  # of migrations/versions, in order
_MIGRATIONS = "service.store.database:migrations"  # package:folder, which Alembic reads with importlib.resources


def revision_of(connection: Connection) -> str | None:
    """Return the revision of a database; None if it has no tables of this software."""
    if not inspect(connection).has_table("alembic_version"):
        return None
    revision: str | None = connection.execute(text("SELECT version_num FROM alembic_version")).scalar_one_or_none()
    return revision


def refuse_newer(present: str | None, where: str) -> None:
    """Raise StoreVersionError if a newer version made or upgraded the database."""
    if present is not None and present not in REVISIONS:
        raise StoreVersionError(
            f"this database was written by a newer version of orthocapture (its revision {present} is unknown here)",
            where=where,
            remedy="Install the version that wrote it, or a newer one; nothing was changed",
        )


def refuse_foreign(connection: Connection, where: str, remedy: str) -> None:
    """Raise StoreVersionError if a database without a revision has tables."""
    if inspect(connection).get_table_names():
        raise StoreVersionError("this is not a database of orthocapture", where=where, remedy=remedy)


def migrate(connection: Connection) -> None:
    """Upgrade a database of an earlier version by the migrations; also an empty one of SQLite."""
    # The import takes half a second and is needed only where an earlier version wrote the database.
    from alembic import command  # noqa: PLC0415
    from alembic.config import Config  # noqa: PLC0415

    config = Config()
    config.set_main_option("script_location", _MIGRATIONS)
    config.set_main_option("path_separator", "os")
    config.attributes["connection"] = connection
    command.upgrade(config, "head")


def refuse_changes(connection: Connection, table: str, key: str) -> None:
    """Make a new table of evidence append-only by triggers, in a migration.

    Args:
        connection: a connection of the tables' owner.
        table: the name of the table.
        key: the condition on NEW, in SQL of SQLite, under which a row exists already. INSERT OR REPLACE would delete
            that row without firing the trigger on DELETE.
    """
    statements = postgres_triggers(table) if is_postgres(connection) else _sqlite_triggers(table, key)
    for statement in statements:
        connection.exec_driver_sql(statement)


def postgres_triggers(table: str) -> tuple[str, ...]:
    """Return the statements that make a table append-only in PostgreSQL."""
    return (
        f"CREATE TRIGGER {table}_append_only BEFORE UPDATE OR DELETE ON {table} "
        "FOR EACH ROW EXECUTE FUNCTION refuse_change()",
        f"CREATE TRIGGER {table}_no_truncate BEFORE TRUNCATE ON {table} "
        "FOR EACH STATEMENT EXECUTE FUNCTION refuse_change()",
    )


def _sqlite_triggers(table: str, key: str) -> tuple[str, ...]:
    return (
        *(
            f"CREATE TRIGGER {table}_no_{verb} BEFORE {verb.upper()} ON {table} "
            f"BEGIN SELECT RAISE(ABORT, '{table} is append-only: {verb} refused'); END"
            for verb in ("update", "delete")
        ),
        f"CREATE TRIGGER {table}_no_replace BEFORE INSERT ON {table} "
        f"WHEN EXISTS (SELECT 1 FROM {table} WHERE {key}) "
        f"BEGIN SELECT RAISE(ABORT, '{table} is append-only: replace refused'); END",
    )


_log = logging.getLogger(__name__)
Channel = Literal["chains", "jobs"]
_NOTIFY = text("SELECT pg_notify(:channel, :run)")


def notify(connection: Connection, channel: Channel, run_id: str) -> None:
    """Wake whoever listens once this transaction is committed; it is told only which chain grew. SQLite is polled."""
    if is_postgres(connection):
        connection.execute(_NOTIFY, {"channel": f"orthocapture_{channel}", "run": run_id})


class Changes(ABC):
    """Waits for whoever has looked and found nothing. One thread uses it."""

    @abstractmethod
    def wait(self, seconds: float) -> None:
        """Return after so many seconds at the latest, earlier if there may be something new."""

    @abstractmethod
    def close(self) -> None:
        """Listen no longer."""


class PolledChanges(Changes):
    """Waits the whole time."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock

    def wait(self, seconds: float) -> None:
        """Sleep."""
        self._clock.sleep(seconds)

    def close(self) -> None:
        """Do nothing."""


class HeardChanges(Changes):
    """Listens with a connection of its own. While that is lost it polls, and it connects again at the next wait."""

    def __init__(self, engine: Engine, channel: Channel, clock: Clock) -> None:
        self._engine, self._channel, self._clock = engine, channel, clock
        self._connection: Connection | None = None

    def wait(self, seconds: float) -> None:
        """Wait for a notification; without a connection, sleep."""
        try:
            if self._connection is None:
                self._listen()  # and look once more: what came before was not heard
                return
            session: Any = self._connection.connection.dbapi_connection
            for _ in session.notifies(timeout=seconds, stop_after=1):
                pass
        except (SQLAlchemyError, OSError, self._driver_error()) as error:
            _log.warning("changes of the database are not heard but polled for: %s", error)
            self.close()
            self._clock.sleep(seconds)

    def close(self) -> None:
        """Close the connection."""
        if self._connection is not None:
            with suppress(SQLAlchemyError, self._driver_error()):
                self._connection.close()
            self._connection = None

    def _listen(self) -> None:
        connection = self._engine.connect().execution_options(isolation_level="AUTOCOMMIT")
        connection.detach()  # a pool would hand a listening connection to somebody else
        self._connection = connection
        connection.execute(text(f"LISTEN orthocapture_{self._channel}"))

    @staticmethod
    def _driver_error() -> type[Exception]:
        import psycopg  # noqa: PLC0415 - for sites only

        return psycopg.Error
