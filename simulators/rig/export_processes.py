"""The processes that export what scanner and CT of a simulated rig deliver: when asked, or computed ahead."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

_NICE = 10  # of an export that is computed ahead: whatever somebody waits for goes first
_NEXT = {"start": "ct", "ct_scan": "scanner", "spray": "scanner"}  # what is usually asked for after these


class ExportProcesses:
    """Exports of the scanner (`scanner`) and of the CT (`ct`), each computed by a process of its own.

    With `ahead`, the next export is computed while the rig is used for other things, and written when it is asked
    for. If the scene has changed since, it is dropped and computed again.
    """

    def __init__(
        self, logs: Path, options: Callable[[str], Sequence[str]], *, ahead: bool, running: Callable[[], bool]
    ) -> None:
        """`options(simulator)`: its command line for the scene as it is; `running`: False once the rig ends."""
        self._logs, self._options, self._ahead, self._running = logs, options, ahead, running
        self._lock = threading.Lock()
        self._changes = threading.Lock()
        self._processes: list[subprocess.Popen[str]] = []
        self._prepared: dict[str, tuple[Sequence[str], subprocess.Popen[str]]] = {}

    def prepare_after(self, action: str) -> None:
        """Begin to compute the export that is usually asked for after this action, if the rig works ahead."""
        simulator = _NEXT.get(action)
        if simulator is None or not self._ahead:
            return
        with self._lock:
            self._drop(simulator)
            options = self._options(simulator)
            self._prepared[simulator] = (options, self._start(simulator, [*options, "--when-told"]))

    def deliver(self, simulator: str) -> dict[str, Any]:
        """Write one export of the scene as it is; what the simulator reports of it, or the error."""
        with self._lock:
            options = self._options(simulator)
            prepared_for, process = self._prepared.get(simulator, ((), None))
            if process is None or list(prepared_for) != list(options):
                self._drop(simulator)
                process = self._start(simulator, options)
            else:
                del self._prepared[simulator]
            printed, errors = process.communicate("now\n")
            with self._changes:
                self._processes.remove(process)
        (self._logs / f"{simulator}.log").write_text(errors)
        if process.returncode != 0:
            return {"ok": False, "error": errors.strip().splitlines()[-1] if errors else "it failed"}
        return {"ok": True, **json.loads(printed.splitlines()[0])}

    def stop(self) -> Sequence[subprocess.Popen[str]]:
        """Tell all exports under way to end; returns their processes."""
        with self._changes:
            for process in self._processes:
                process.terminate()
            return tuple(self._processes)

    def _start(self, simulator: str, options: Sequence[str]) -> subprocess.Popen[str]:
        ahead = "--when-told" in options
        command = [sys.executable, "-m", "simulators", simulator, "--once", "--parent", str(os.getpid()), *options]
        with self._changes:
            process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
            )
            self._processes.append(process)
        if ahead:
            with suppress(OSError):  # it has ended already, which `deliver` reports
                os.setpriority(os.PRIO_PROCESS, process.pid, _NICE)
        if not self._running():
            process.terminate()
        return process

    def _drop(self, simulator: str) -> None:
        _, process = self._prepared.pop(simulator, ((), None))
        if process is not None:
            process.kill()
            process.communicate()
            with self._changes:
                self._processes.remove(process)
