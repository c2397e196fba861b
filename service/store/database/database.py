"""What the store asks of its database, SQLite in a data folder or PostgreSQL of a site."""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import AbstractContextManager

from sqlalchemy import Column, ColumnElement, Connection, DateTime, Double, Engine, cast, extract, func, text

from service.store.durable_effects import Clock

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
