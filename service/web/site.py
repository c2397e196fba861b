"""What every page works on: the data folder, the rig, the people, and the runners started from here."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import Annotated, cast
from weakref import WeakValueDictionary

from fastapi import Depends, Request

from service.core.run.expected import EarlierTimes
from service.people.sessions import People
from service.rig import Rig, RigDevice
from service.run_record import RunFollower, RunRecord
from service.run_start import recorded_run, second_place
from service.store.signatures.second_place import SecondPlace
from service.store.store import Store
from service.web.launch import Launcher
from service.web.server.open_streams import OpenStreams


@dataclass
class OpenedRuns:
    """The runs whose pages were asked for. The first read of a run takes long; only its own pages wait for it.

    `first_read` reads a run from its beginning; its errors go to whoever asked, and the next one tries again.
    """

    first_read: Callable[[str], RunFollower]
    _runs: dict[str, RunFollower] = field(init=False, default_factory=dict[str, RunFollower])
    # A lock exists only while somebody uses it, so that invented names of runs leave nothing behind.
    _locks: WeakValueDictionary[str, Lock] = field(init=False, default_factory=WeakValueDictionary[str, Lock])
    _lock: Lock = field(init=False, default_factory=Lock)  # of the two above; held for moments

    def now(self, run_id: str) -> RunRecord:
        """A run's record as of now. Raises what `first_read` raises, and IntegrityError."""
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
    devices_of: Callable[[Rig], Mapping[str, RigDevice]]  # of a rig file, by name
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
        """A run's record as of now. Raises UnknownRunError, IntegrityError."""
        return self.runs.now(run_id)

    def step_times(self, run_id: str) -> EarlierTimes:
        """How long the steps took in the runs before this one; read once. Raises UnknownRunError, StoreError."""
        if run_id not in self._step_times:
            from service.monitor.figures import read_step_times  # noqa: PLC0415 - of runs under way only

            self._step_times[run_id] = read_step_times(self.store, run_id)
        return self._step_times[run_id]

    def protocol_files(self) -> list[Path]:
        """Protocols that can be started."""
        return sorted(self.protocols.glob("*.yaml"))

    def _first_read(self, run_id: str) -> RunFollower:
        protocol, _ = recorded_run(self.store, run_id)
        return RunFollower(self.store, run_id, protocol)


def _site(request: Request) -> Site:
    return cast(Site, request.app.state.site)


CurrentSite = Annotated[Site, Depends(_site)]
