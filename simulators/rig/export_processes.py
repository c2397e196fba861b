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
    """Exports of the CT (`ct`) and of the scanners, by their devices; each is computed by a process of its own.

    With `ahead`, the next export is computed while the rig is used for other things, and written when it is asked
    for. If the scene has changed since, it is dropped and computed again.
    """

    def __init__(
        self, logs: Path, command: Callable[[str], tuple[str, ...]], *, ahead: bool, running: Callable[[], bool]
    ) -> None:
        """`command(device)`: of its simulator, for the scene as it is; `running()`: False once the rig ends."""
        self._logs, self._command, self._ahead, self._running = logs, command, ahead, running
        self._lock = threading.Lock()
        self._changes = threading.Lock()
        self._processes: list[subprocess.Popen[str]] = []
        self._prepared: dict[str, tuple[tuple[str, ...], subprocess.Popen[str]]] = {}

    def prepare_after(self, action: str) -> None:
        """Begin to compute the export that is usually asked for after this action, if the rig works ahead."""
        device = _NEXT.get(action)
        if device is None or not self._ahead:
            return
        with self._lock:
            self._drop(device)
            command = self._command(device)
            self._prepared[device] = (command, self._start([*command, "--when-told"], _NICE))

    def deliver(self, device: str) -> dict[str, Any]:
        """Write one export of the scene as it is; what the simulator reports of it, or the error."""
        with self._lock:
            command = self._command(device)
            prepared, process = self._prepared.get(device, ((), None))
            if process is None or prepared != command:
                self._drop(device)
                process = self._start(command)
            else:
                del self._prepared[device]
            printed, errors = process.communicate("now\n")
            with self._changes:
                self._processes.remove(process)
        (self._logs / f"{device}.log").write_text(errors)
        if process.returncode != 0:
            return {"ok": False, "error": errors.strip().splitlines()[-1] if errors else "it failed"}
        return {"ok": True, **json.loads(printed.splitlines()[0])}

    def stop(self) -> Sequence[subprocess.Popen[str]]:
        """Tell all exports under way to end; returns their processes."""
        with self._changes:
            for process in self._processes:
                process.terminate()
            return tuple(self._processes)

    def _start(self, command: Sequence[str], nice: int = 0) -> subprocess.Popen[str]:
        words = [sys.executable, "-m", "simulators", *command, "--once", "--parent", str(os.getpid())]
        with self._changes:
            process = subprocess.Popen(
                words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
            )
            self._processes.append(process)
        if nice:
            with suppress(OSError):  # it has ended already, which `deliver` reports
                os.setpriority(os.PRIO_PROCESS, process.pid, os.getpriority(os.PRIO_PROCESS, 0) + nice)
        if not self._running():
            process.terminate()
        return process

    def _drop(self, device: str) -> None:
        _, process = self._prepared.pop(device, ((), None))
        if process is not None:
            process.kill()
            process.communicate()
            with self._changes:
                self._processes.remove(process)
