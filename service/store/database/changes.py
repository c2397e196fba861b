"""Waiting until something may have changed in the database: by polling, or by PostgreSQL's LISTEN and NOTIFY."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from contextlib import suppress
from typing import Any, Literal

from sqlalchemy import Connection, Engine, text
from sqlalchemy.exc import SQLAlchemyError

from service.store.database.database import is_postgres
from service.store.durable_effects import Clock

_LOG = logging.getLogger(__name__)
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
            _LOG.warning("changes of the database are not heard but polled for: %s", error)
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
