"""Keeps the rows of runs and their leases: each run has one runner, which holds it while that lives."""

from __future__ import annotations

import logging
import socket
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Literal, Self

import psutil
from sqlalchemy import Connection, Row, bindparam, delete, insert, select, update

from service.core.errors import StoreError
from service.core.records.events import SiteOpened
from service.core.records.run_events import RunStarted
from service.store.artefacts import ArtefactFiles, insert_artefacts
from service.store.database.database import Database, is_postgres, lease_now_s
from service.store.database.tables import event_facets, event_index, heads, leases, runs
from service.store.durable_effects import Clock, IdSource, SystemClock
from service.store.event_index import OF_FACET
from service.store.events import ROOT, append, moved_runs
from service.store.records import SITE, LeaseHeldError, LeaseLostError, NewArtefact, RunRow, UnknownRunError

_ENDS = ("run_completed", "run_aborted")


def defer_references(connection: Connection) -> None:
    """Have rows that refer to others checked when the transaction is committed."""
    postgres = is_postgres(connection)
    connection.exec_driver_sql("SET CONSTRAINTS ALL DEFERRED" if postgres else "PRAGMA defer_foreign_keys = ON")


def begin_chain(
    connection: Connection,
    clock: Clock,
    folder: ArtefactFiles,
    run_id: str,
    payload: RunStarted | SiteOpened,
    actor: str,
    artefacts: Sequence[NewArtefact],
) -> None:
    """Insert the row of a run, or of the site, with the first event of its chain and the artefacts of that event."""
    # The run's row holds the hash of the root event, which refers to the row; keys are checked at commit.
    defer_references(connection)
    connection.execute(insert(heads).values(run_id=run_id, seq=0, sha256=ROOT))
    (root,) = append(connection, clock, run_id, [payload], actor)
    simulated = isinstance(payload, RunStarted) and payload.simulated
    connection.execute(
        insert(runs).values(
            run_id=run_id,
            created_utc=root.at_utc,
            simulated=int(simulated),
            root_sha256=root.sha256,
        )
    )
    insert_artefacts(connection, folder, [root], artefacts)


def read_runs(connection: Connection) -> list[RunRow]:
    """Return all runs, oldest first, without the site's chain."""
    statement = (
        select(runs, heads.c.seq, heads.c.sha256)
        .outerjoin(heads, heads.c.run_id == runs.c.run_id)
        .where(runs.c.run_id != SITE)
        .order_by(runs.c.created_utc, runs.c.run_id)
    )
    return [
        RunRow(row.run_id, row.created_utc, bool(row.simulated), row.root_sha256, row.seq or 0, row.sha256 or ROOT)
        for row in connection.execute(statement)
    ]


def read_open_runs(connection: Connection) -> set[str]:
    """Return runs with neither an end recorded by the runner nor an operator's abort, which it confirms later.

    A run that goes on in another record is not among them.
    """
    ended = (
        select(event_index.c.seq)
        .where(event_index.c.run_id == heads.c.run_id, event_index.c.kind.in_(_ENDS))
        .exists()
    )
    aborted = (
        select(event_facets.c.seq)
        .join(event_index, OF_FACET)
        .where(
            event_facets.c.run_id == heads.c.run_id,
            event_facets.c.name == "action",
            event_facets.c.value == "abort",
            event_index.c.kind == "operator_action",
        )
        .correlate(heads)
        .exists()
    )
    found = select(heads.c.run_id).where(heads.c.run_id != SITE, ~ended, ~aborted)
    return set(connection.execute(found).scalars()) - moved_runs(connection)


def resolve_run(known: Sequence[RunRow], name: str) -> str:
    """Return the run for a full name, an unambiguous beginning, or `latest`. Raises UnknownRunError."""
    if not known:
        raise UnknownRunError("there is no run in this data folder yet", remedy="Start one with `orthocapture run`")
    if name == "latest":
        return known[-1].run_id
    matches = [run.run_id for run in known if run.run_id == name] or [
        run.run_id for run in known if name and run.run_id.startswith(name)
    ]
    if len(matches) != 1:
        newest = ", ".join(run.run_id for run in known[-3:])
        what = f"no run is called {name!r}" if not matches else f"{name!r} is the beginning of {len(matches)} runs"
        raise UnknownRunError(what, remedy=f"The newest are: {newest}; or say `latest`")
    return matches[0]


# Leases: one runner per run. A process on this host holds its lease as long as it lives, others for a limited time.
#
# A runner alive on this host never loses its run to a timeout: the clock may be set, a wait may be long, and a
# process stopped by SIGSTOP would go on moving the arm when it is continued.


_SAME_START_S = 1.5  # the boot time is known to one second
_HELD = select(leases.c.run_id).where(leases.c.token == bindparam("held"))  # put together once: every record asks it
_LEASES = select(leases).order_by(leases.c.run_id)
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ProcessIdentity:
    """The process that holds a lease, so that another process on the same host can see whether it is still alive.

    `process_started_s` counts from boot, not from an epoch, so that setting the system clock does not change it.
    """

    host: str
    boot: str  # boot id, "" if the system has none; a process of an earlier boot is dead
    pid: int
    process_started_s: float

    @classmethod
    def of_this_process(cls) -> ProcessIdentity:
        """Return the identity of this process."""
        process = psutil.Process()
        return cls(socket.gethostname(), _boot(), process.pid, _started_s(process))

    def life(self) -> Literal["lives", "dead", "unknown"]:
        """Return whether the process is alive; unknown for a process on another host. A stopped process is alive."""
        if self.host != socket.gethostname():
            return "unknown"
        if self.boot != _boot():
            return "dead"
        try:
            process = psutil.Process(self.pid)
            if process.status() == psutil.STATUS_ZOMBIE:
                return "dead"
            same = abs(_started_s(process) - self.process_started_s) <= _SAME_START_S
        except psutil.NoSuchProcess:
            return "dead"
        except psutil.AccessDenied:
            return "unknown"
        return "lives" if same else "dead"


def _boot() -> str:
    return SystemClock().boot()


def _started_s(process: psutil.Process) -> float:
    return process.create_time() - psutil.boot_time()


def identity_of(row: Row[Any]) -> ProcessIdentity:
    """Return the holder named in a row of `leases` or `jobs`."""
    return ProcessIdentity(row.host, row.boot, row.pid, row.process_started_s)


def identity_values(identity: ProcessIdentity) -> dict[str, Any]:
    """Return an identity as column values of `leases` or `jobs`."""
    return {
        "host": identity.host,
        "boot": identity.boot,
        "pid": identity.pid,
        "process_started_s": identity.process_started_s,
    }


class RunLease:
    """The right to drive one run until released or this process dies; within a `with` block it renews itself."""

    def __init__(self, run_id: str, token: str, seconds: float, database: Database, clock: Clock) -> None:
        self.run_id = run_id
        self.token = token
        self._seconds = seconds
        self._database = database
        self._clock = clock
        self._over = clock.signal()
        self._keeper = threading.Thread(target=self._keep, name=f"lease of {run_id}", daemon=True)

    def renew(self) -> None:
        """Extend the lease by its duration from now. Raises LeaseLostError if another process has taken over."""
        with self._database.writing() as connection:
            check_lease(connection, self)
            until = lease_now_s(connection, self._clock) + self._seconds
            connection.execute(update(leases).where(leases.c.token == self.token).values(until_utc_s=until))

    def release(self) -> None:
        """Release the run for the next runner; no effect if already released or taken over."""
        with self._database.writing() as connection:
            connection.execute(delete(leases).where(leases.c.token == self.token))

    def _keep(self) -> None:
        while not self._over.wait(self._seconds / 3):
            try:
                self.renew()
            except LeaseLostError:
                return  # the runner's next write is refused with this error
            except StoreError as error:  # the disk may be full or busy for a moment; try again before the lease ends
                _log.warning("the lease of %s was not renewed: %s", self.run_id, error)

    def __enter__(self) -> Self:
        self._keeper.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._over.set()
        self._keeper.join()
        self.release()


def is_held(connection: Connection, clock: Clock, run_id: str) -> bool:
    """Return whether a process that may still be alive holds the lease of a run."""
    row = connection.execute(select(leases).where(leases.c.run_id == run_id)).one_or_none()
    return row is not None and is_live(row, lease_now_s(connection, clock))


def held_runs(connection: Connection, clock: Clock) -> list[str]:
    """Return names, sorted, of the runs whose lease is held by a process that may still be alive."""
    now_utc_s = lease_now_s(connection, clock)
    rows = connection.execute(_LEASES).all()
    return [row.run_id for row in rows if is_live(row, now_utc_s)]


def is_live(row: Row[Any], now_utc_s: float) -> bool:
    """Return whether the holder in a row of `leases` or `jobs` may be alive; elsewhere, until the lease expires."""
    life = identity_of(row).life()
    return life == "lives" or (life == "unknown" and now_utc_s < row.until_utc_s)


def acquire(database: Database, clock: Clock, ids: IdSource, *, run_id: str, holder: str, seconds: float) -> RunLease:
    """Take the lease of a run. Raises LeaseHeldError, naming the holder, while another process has it.

    A lease of another host that seems to have run out is watched for `seconds` first: this host's clock may have been
    set forward.
    """
    token = ids.new_token()
    silent = _watch(database, clock, run_id, seconds)
    with database.writing() as connection:
        now = lease_now_s(connection, clock)
        row = connection.execute(select(leases).where(leases.c.run_id == run_id)).one_or_none()
        if row is not None:
            if is_live(row, now) or (identity_of(row).life() == "unknown" and _renewal(row) != silent):
                here = row.host == socket.gethostname()
                left_s = row.until_utc_s - now
                raise LeaseHeldError(
                    f"another process drives this run: {row.holder}",
                    where=f"process {row.pid} on {row.host}",
                    remedy="End it" if here else f"End it, or wait {left_s:.0f} s after it has stopped answering",
                )
            connection.execute(delete(leases).where(leases.c.run_id == run_id))
        identity = ProcessIdentity.of_this_process()
        connection.execute(
            insert(leases).values(
                run_id=run_id, holder=holder, token=token, until_utc_s=now + seconds, **identity_values(identity)
            )
        )
    return RunLease(run_id, token, seconds, database, clock)


def _watch(database: Database, clock: Clock, run_id: str, seconds: float) -> tuple[str, float] | None:
    """Return another host's lease that has run out by UTC, once the time in which it would be renewed has passed."""
    with database.reading() as connection:
        row = connection.execute(select(leases).where(leases.c.run_id == run_id)).one_or_none()
        now_utc_s = lease_now_s(connection, clock)
    if row is None or identity_of(row).life() != "unknown" or now_utc_s < row.until_utc_s:
        return None
    _log.warning("watching for %.0f s whether %s on %s still drives %s", seconds, row.holder, row.host, run_id)
    clock.sleep(seconds)
    return _renewal(row)


def _renewal(row: Row[Any]) -> tuple[str, float]:
    return row.token, row.until_utc_s


def check_lease(connection: Connection, lease: RunLease) -> None:
    """Raise LeaseLostError unless the database still holds this lease."""
    if connection.execute(_HELD, {"held": lease.token}).first() is None:
        raise LeaseLostError(
            "another process has taken over this run",
            where=lease.run_id,
            remedy="This one stops; nothing was written",
        )
