"""What every page works on: the data folder, the rig, the people, and the runners started from here."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import Annotated, cast

from fastapi import Depends, Request

from service.people.sessions import People
from service.rig import Rig
from service.run_record import RunFollower, RunRecord
from service.run_start import recorded_run
from service.store.store import Store
from service.web.launch import Launcher
from service.web.server.open_streams import OpenStreams


@dataclass
class Site:
    """One data folder behind one web process."""

    data: Path
    rig: Rig
    protocols: Path  # folder of protocol files that can be started
    store: Store
    people: People
    launcher: Launcher
    secure: bool = True  # cookies are sent over TLS, or to this machine, only
    idle_lock_s: float = 600.0
    hosts: tuple[str, ...] = ("127.0.0.1", "localhost")  # names by which browsers may ask
    sealed_seq: int = 0  # last event of the site's chain that is known to be signed
    streams: OpenStreams = field(default_factory=OpenStreams)
    _runs: dict[str, RunFollower] = field(default_factory=dict[str, RunFollower])
    _lock: Lock = field(default_factory=Lock)

    def run(self, run_id: str) -> RunRecord:
        """A run's record as of now. Raises UnknownRunError, IntegrityError."""
        with self._lock:
            if run_id not in self._runs:
                protocol, _ = recorded_run(self.store, run_id)
                self._runs[run_id] = RunFollower(self.store, run_id, protocol)
            run = self._runs[run_id]
        return run.now()

    def protocol_files(self) -> list[Path]:
        """Protocols that can be started."""
        return sorted(self.protocols.glob("*.yaml"))


def _site(request: Request) -> Site:
    return cast(Site, request.app.state.site)


CurrentSite = Annotated[Site, Depends(_site)]
