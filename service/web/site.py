"""Holds what every page works on: data folder, rig, people, runners started from here, spool, log of starts."""

from __future__ import annotations

import contextlib
import hashlib
import os
import socket
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Annotated, TypeVar, cast
from weakref import WeakValueDictionary

from fastapi import Depends, Request
from fastapi import Path as UrlPath
from sqlalchemy import Connection, func, select

from service.core.errors import ConfigurationError, OrthocaptureError
from service.core.records.events import Event, ServiceStarted
from service.core.run.expected import EarlierTimes
from service.followed_run import RunFollower, RunRecord
from service.monitor.snapshot import Snapshot, log_path, write_snapshot
from service.people.sessions import People
from service.rig import Rig, RigDevice
from service.run_start import recorded_run, require_rig_free, second_place
from service.runner.held_run import software_versions
from service.store.data_folder import SITE_FILE
from service.store.database.tables import checkpoints, event_index, events, heads
from service.store.durable_effects import Clock
from service.store.events import to_event
from service.store.records import SITE
from service.store.runs import ProcessIdentity, read_open_runs
from service.store.signatures.second_place import SecondPlace
from service.store.store import Store
from service.web.connections import OpenStreams

if TYPE_CHECKING:
    from service.store.objects.spool import SpoolLevel


@dataclass
class Launcher:
    """Runners of one data folder. Whether one lives is asked of the database: it may have another parent."""

    data: Path
    store: Store
    _children: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict[str, "subprocess.Popen[bytes]"])
    _lock: Lock = field(default_factory=Lock)

    def driven(self, run_id: str) -> bool:
        """Return whether a living process drives the run, or one has just been started to do so."""
        with self._lock:
            child = self._children.get(run_id)
            if child is not None and child.poll() is None:
                return True
        return self.store.driven(run_id)

    def driven_runs(self) -> list[str]:
        """Return all runs of which `driven` is true, by name."""
        with self._lock:
            started = {run_id for run_id, child in self._children.items() if child.poll() is None}
        return sorted(started.union(self.store.driven_runs()))

    def start(self, run_id: str) -> None:
        """Start a runner. Raises ConfigurationError when the run has one, or it cannot be started."""
        if self.driven(run_id):
            raise ConfigurationError("a process drives this run already", where=run_id, remedy="Reload the page")
        _, root = recorded_run(self.store, run_id)
        require_rig_free(self.store, Path(root.rig.original_name), run_id=run_id)
        log = log_path(self.data, run_id)
        command = [sys.executable, "-m", "service.cli.main", "resume", run_id, "--data", str(self.data), "--screens"]
        try:
            log.parent.mkdir(parents=True, exist_ok=True)
            with log.open("ab") as output:
                child = subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=output,
                    start_new_session=True,  # neither Ctrl-C nor the end of this process reaches it
                )
        except OSError as error:
            raise ConfigurationError(
                f"the process that drives the run cannot be started: {error.strerror or error}", where=str(log)
            ) from error
        with self._lock:
            self._children[run_id] = child
        now_s = self.store.clock.utc_s()
        first = Snapshot(at_utc_s=now_s, pid=child.pid, doing="starting", activity="starting", activity_utc_s=now_s)
        with contextlib.suppress(OSError):  # the runner will report by itself soon
            write_snapshot(self.data, run_id, first)


@dataclass
class OpenedRuns:
    """The runs whose pages were asked for. The first read of a run takes long; only its own pages wait for it.

    `first_read` reads a run from its beginning; its errors go to whoever asked, and the next one tries again.
    """

    first_read: Callable[[str], RunFollower]
    _runs: dict[str, RunFollower] = field(init=False, default_factory=dict[str, RunFollower])
    # A lock exists only while somebody uses it, so that invented names of runs leave nothing behind.
    _locks: WeakValueDictionary[str, Lock] = field(init=False, default_factory=WeakValueDictionary[str, Lock])
    _lock: Lock = field(init=False, default_factory=Lock)  # lock of the two above; held for moments

    def now(self, run_id: str) -> RunRecord:
        """Return a run's record as of now. Raises what `first_read` raises, and IntegrityError."""
        with self._lock:
            run = self._runs.get(run_id)
            lock = self._locks.setdefault(run_id, Lock())
        if run is None:
            with lock:
                run = self._runs.get(run_id) or self.first_read(run_id)
                self._runs[run_id] = run
        return run.now()


@dataclass
class Site:
    """One data folder behind one web process."""

    data: Path
    rig: Rig
    protocols: Path  # folder of protocol files that can be started
    store: Store
    people: People
    launcher: Launcher
    devices_of: Callable[[Rig], Mapping[str, RigDevice]]  # returns the devices of a rig file, by name
    secure: bool = True  # cookies are sent over TLS, or to this machine, only
    idle_lock_s: float = 600.0
    hosts: tuple[str, ...] = ("127.0.0.1", "localhost")  # names by which browsers may ask
    second_place: SecondPlace = field(init=False)
    sealed_seq: int = 0  # last event of the site's chain that is known to be signed
    streams: OpenStreams = field(default_factory=OpenStreams)
    runs: OpenedRuns = field(init=False)
    _step_times: dict[str, EarlierTimes] = field(init=False, default_factory=dict[str, EarlierTimes])

    def __post_init__(self) -> None:
        self.runs = OpenedRuns(self._first_read)
        self.second_place = second_place(self.rig, self.store)

    def run(self, run_id: str) -> RunRecord:
        """Return a run's record as of now. Raises UnknownRunError, IntegrityError."""
        return self.runs.now(run_id)

    def step_times(self, run_id: str) -> EarlierTimes:
        """Return how long the steps took in the runs before this one; read once.

        Raises UnknownRunError, StoreError.
        """
        if run_id not in self._step_times:
            from service.monitor.figures import read_step_times  # noqa: PLC0415 - of runs under way only

            self._step_times[run_id] = read_step_times(self.store, run_id)
        return self._step_times[run_id]

    def protocol_files(self) -> list[Path]:
        """Return protocols that can be started."""
        return sorted(self.protocols.glob("*.yaml"))

    def _first_read(self, run_id: str) -> RunFollower:
        protocol, _ = recorded_run(self.store, run_id)
        return RunFollower(self.store, run_id, protocol)


def _site(request: Request) -> Site:
    return cast(Site, request.app.state.site)


CurrentSite = Annotated[Site, Depends(_site)]
_Made = TypeVar("_Made")
_MAKING = Lock()


def singleton(name: str, make: Callable[[Site], _Made]) -> Callable[[Request], _Made]:
    """Return a dependency of pages: what is made for an application at its first use and stays in its state."""

    def instance(request: Request) -> _Made:
        state = request.app.state
        with _MAKING:
            if not hasattr(state, name):
                setattr(state, name, make(state.site))
            return cast(_Made, getattr(state, name))

    return instance


RunId = Annotated[str, UrlPath(max_length=64)]


def spool_of(site: Site) -> SpoolLevel | None:
    """Return how full the spool is; None for a site without an object store, or whose site.yaml is wrong."""
    try:
        return _level(site)
    except OrthocaptureError:
        return None  # the page of the runs says what is wrong


def spool_sentence(site: Site) -> str:
    """Return how full the spool is, and what hinders it, as a sentence; "" for a site without an object store."""
    try:
        level = _level(site)
    except OrthocaptureError as error:
        return f"nothing is uploaded: {error}"
    return "" if level is None else level.sentence


def _level(site: Site) -> SpoolLevel | None:
    if not (site.data / SITE_FILE).is_file():
        return None
    from service.store.objects.spool import spool_level  # noqa: PLC0415 - for sites only

    return spool_level(site.store)


# --- the log of starts: what runs here, what changed since the last start, and which runs are open ----------------


def record_start(store: Store, rig: Rig, protocols: Sequence[Path], address: str) -> ServiceStarted:
    """Record in the site's chain that the service started, with its files, its software and the open runs.

    The record holds the ends of all chains that grew since the last start, which reveal a run that is cut later.
    Raises ConfigurationError for a protocol file that cannot be read.
    """
    software = software_versions()
    configuration = {str(rig.path): hashlib.sha256(rig.source).hexdigest()} | _hashes(protocols)
    boot = ProcessIdentity.of_this_process().boot
    with store.database.writing() as connection:
        last, position = _last_start(connection)
        before = last.payload if last is not None and isinstance(last.payload, ServiceStarted) else None
        started = ServiceStarted(
            host=socket.gethostname(),
            pid=os.getpid(),
            address=address,
            software=software,
            changed={
                **_changes(before.software if before else {}, software),
                **_changes(before.configuration if before else {}, configuration),
            }
            if before
            else {},
            configuration=configuration,
            boot=boot,
            clock_jump_s=_clock_jump_s(store.clock, last) if last is not None and _same_boot(before, boot) else None,
            heads=_heads_since(connection, position),
            unsigned_runs=_unsigned_runs(connection),
            open_runs=tuple(sorted(read_open_runs(connection))),
        )
        store.append_site(connection, [started], actor="service", software=software)
    return started


def _hashes(files: Sequence[Path]) -> dict[str, str]:
    try:
        return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
    except OSError as error:
        raise ConfigurationError(
            f"a protocol file cannot be read: {error.strerror}", where=str(error.filename)
        ) from error


def _changes(before: Mapping[str, str], now: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """Name → before, now; "" for what did not exist."""
    names = sorted({*before, *now})
    return {n: (before.get(n, ""), now.get(n, "")) for n in names if before.get(n) != now.get(n)}


def _last_start(connection: Connection) -> tuple[Event | None, int]:
    """Return the last ServiceStarted and its position among all events; (None, 0) if there is none."""
    found = (
        select(event_index.c.seq, event_index.c.position)
        .where(event_index.c.run_id == SITE, event_index.c.kind == "service_started")
        .order_by(event_index.c.seq.desc())
        .limit(1)
    )
    place = connection.execute(found).one_or_none()
    if place is None:
        return None, 0
    row = connection.execute(select(events).where(events.c.run_id == SITE, events.c.seq == place.seq)).one()
    return to_event(row), place.position


def _same_boot(before: ServiceStarted | None, boot: str) -> bool:
    return before is not None and boot != "" and (before.boot, before.host) == (boot, socket.gethostname())


def _clock_jump_s(clock: Clock, last: Event) -> float:
    """Return seconds by which UTC advanced more than the monotonic clock since the last start: how far it was set."""
    utc_s = clock.utc_s() - datetime.fromisoformat(last.at_utc).timestamp()
    return round(utc_s - (clock.monotonic_s() - last.monotonic_s), 6)


def _heads_since(connection: Connection, position: int) -> dict[str, tuple[int, str]]:
    grown = select(event_index.c.run_id).where(event_index.c.position > position).distinct()
    found = select(heads).where(heads.c.run_id.in_(grown), heads.c.run_id != SITE).order_by(heads.c.run_id)
    return {row.run_id: (row.seq, row.sha256) for row in connection.execute(found)}


def _unsigned_runs(connection: Connection) -> tuple[str, ...]:
    signed = (
        select(checkpoints.c.run_id, func.max(checkpoints.c.seq).label("seq"))
        .group_by(checkpoints.c.run_id)
        .subquery()
    )
    found = (
        select(heads.c.run_id)
        .outerjoin(signed, signed.c.run_id == heads.c.run_id)
        .where(heads.c.run_id != SITE, func.coalesce(signed.c.seq, 0) < heads.c.seq)
        .order_by(heads.c.run_id)
    )
    return tuple(connection.execute(found).scalars())
