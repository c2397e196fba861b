"""Starts the process that drives a run, detached from this one: a restart of the web does not disturb a capture."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock

from service.core.errors import ConfigurationError
from service.monitor.snapshot import Snapshot, log_path, write_snapshot
from service.run_start import recorded_run, require_rig_free
from service.store.store import Store


@dataclass
class Launcher:
    """Runners of one data folder. Whether one lives is asked of the database: it may have another parent."""

    data: Path
    store: Store
    _children: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict[str, "subprocess.Popen[bytes]"])
    _lock: Lock = field(default_factory=Lock)

    def driven(self, run_id: str) -> bool:
        """Whether a living process drives the run, or one has just been started to do so."""
        with self._lock:
            child = self._children.get(run_id)
            if child is not None and child.poll() is None:
                return True
        return self.store.driven(run_id)

    def driven_runs(self) -> list[str]:
        """All runs of which `driven` is true, by name."""
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
