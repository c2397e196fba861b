"""Leases: one runner a run, with a time limit, taken over at once from a dead process of this host."""

from __future__ import annotations

import socket
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import psutil
from sqlalchemy import Connection, Row, delete, insert, select, update

from service.store.database import Database
from service.store.errors import LeaseHeldError, LeaseLostError
from service.store.seam import Clock, Ids
from service.store.tables import leases

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_SAME_START_S = 1.5  # boot time is known to a second


@dataclass(frozen=True, slots=True)
class ProcessIdentity:
    """Who holds a lease, so that another process of the same host can tell whether it still lives.

    `process_started_s` counts from boot, not from an epoch: a step of the system clock does not change it.
    """

    host: str
    boot: str  # boot id where the system has one: a process of an earlier boot is dead
    pid: int
    process_started_s: float

    @classmethod
    def of_this_process(cls) -> ProcessIdentity:
        """This process."""
        process = psutil.Process()
        return cls(socket.gethostname(), _boot(), process.pid, _started_s(process))

    def is_surely_dead(self) -> bool:
        """True only for a process of this host that is gone; nothing is known of other hosts."""
        if self.host != socket.gethostname():
            return False
        if self.boot != _boot():
            return True
        try:
            process = psutil.Process(self.pid)
            if process.status() == psutil.STATUS_ZOMBIE:
                return True
            return abs(_started_s(process) - self.process_started_s) > _SAME_START_S
        except psutil.NoSuchProcess:
            return True
        except psutil.AccessDenied:
            return False


def _boot() -> str:
    return _BOOT_ID.read_text().strip() if _BOOT_ID.exists() else ""


def _started_s(process: psutil.Process) -> float:
    return process.create_time() - psutil.boot_time()


def identity_of(row: Row[Any]) -> ProcessIdentity:
    """The holder that a row of `leases` or `jobs` names."""
    return ProcessIdentity(row.host, row.boot, row.pid, row.process_started_s)


def identity_values(identity: ProcessIdentity) -> dict[str, Any]:
    """The same as column values."""
    return {
        "host": identity.host,
        "boot": identity.boot,
        "pid": identity.pid,
        "process_started_s": identity.process_started_s,
    }


class RunLease:
    """The right to drive one run, until it expires, is released, or this process dies. Use it in a `with`."""

    def __init__(self, run_id: str, token: str, seconds: float, database: Database, clock: Clock) -> None:
        self.run_id = run_id
        self.token = token
        self._seconds = seconds
        self._database = database
        self._clock = clock

    def renew(self) -> None:
        """Push the time limit out again. Raises LeaseLostError when another process has taken over."""
        with self._database.writing() as connection:
            check_lease(connection, self)
            until = self._clock.utc_now().timestamp() + self._seconds
            connection.execute(update(leases).where(leases.c.token == self.token).values(until_utc_s=until))

    def release(self) -> None:
        """Let the next runner in; releasing twice, or after a take-over, does nothing."""
        with self._database.writing() as connection:
            connection.execute(delete(leases).where(leases.c.token == self.token))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.release()


def is_held(connection: Connection, clock: Clock, run_id: str) -> bool:
    """Whether somebody has the lease of a run who may still live."""
    row = connection.execute(select(leases).where(leases.c.run_id == run_id)).one_or_none()
    return row is not None and _is_live(row, clock.utc_now().timestamp())


def held_runs(connection: Connection, clock: Clock) -> list[str]:
    """Runs whose lease somebody has who may still live, by name."""
    now_utc_s = clock.utc_now().timestamp()
    rows = connection.execute(select(leases).order_by(leases.c.run_id)).all()
    return [row.run_id for row in rows if _is_live(row, now_utc_s)]


def _is_live(row: Row[Any], now_utc_s: float) -> bool:
    return now_utc_s < row.until_utc_s and not identity_of(row).is_surely_dead()


def acquire(database: Database, clock: Clock, ids: Ids, *, run_id: str, holder: str, seconds: float) -> RunLease:
    """Take the lease of a run. Raises LeaseHeldError naming who has it and how long."""
    token = ids.new_token()
    with database.writing() as connection:
        now = clock.utc_now().timestamp()
        row = connection.execute(select(leases).where(leases.c.run_id == run_id)).one_or_none()
        if row is not None:
            if _is_live(row, now):
                raise LeaseHeldError(
                    f"another process drives this run: {row.holder}",
                    where=f"process {row.pid} on {row.host}",
                    remedy=f"Stop it, or wait {row.until_utc_s - now:.0f} s after it has stopped answering",
                )
            connection.execute(delete(leases).where(leases.c.run_id == run_id))
        identity = ProcessIdentity.of_this_process()
        connection.execute(
            insert(leases).values(
                run_id=run_id, holder=holder, token=token, until_utc_s=now + seconds, **identity_values(identity)
            )
        )
    return RunLease(run_id, token, seconds, database, clock)


def check_lease(connection: Connection, lease: RunLease) -> None:
    """Raises LeaseLostError unless the lease is still the one in the database."""
    if connection.execute(select(leases.c.run_id).where(leases.c.token == lease.token)).first() is None:
        raise LeaseLostError(
            "another process has taken over this run",
            where=lease.run_id,
            remedy="This one stops; nothing was written",
        )
