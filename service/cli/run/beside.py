"""The worker process beside a run: it ends with the run and is replaced if it dies."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

from service.cli.run.ending import end_with_children

_GRACE_S = 10.0
_POLL_S = 0.5
_FIRST_WAIT_S, _LONGEST_WAIT_S = 1.0, 60.0  # before a dead worker is replaced; doubled each time


@contextmanager
def worker_beside(data: Path, tell: Callable[[str], object]) -> Generator[None]:
    """Run a worker process until the end of this block or of this process; `tell` is called when one dies."""
    beside = _WorkerProcess(data, tell)
    keeper = threading.Thread(target=beside.keep, name="keeper of the worker", daemon=True)
    keeper.start()
    try:
        yield
    finally:
        beside.over.set()
        keeper.join()
        beside.end()


class _WorkerProcess:
    def __init__(self, data: Path, tell: Callable[[str], object]) -> None:
        self.over = threading.Event()
        self._tell = tell
        # Pass the parent's process id: a worker that asks for it itself may ask after the parent has died.
        words = ["worker", "--data", str(data), "--json", "--parent", str(os.getpid())]
        self._command = [sys.executable, "-m", "service.cli.main", *words]
        self._process = self._start()

    def keep(self) -> None:
        """Replace the worker whenever it dies, until `over`. Its successor begins the interrupted job again."""
        wait_s = _FIRST_WAIT_S
        while not self.over.wait(_POLL_S):
            status = self._process.poll()
            if status is None:
                continue
            self._tell(f"the worker process has ended (status {status}); another one is started")
            if self.over.wait(wait_s):
                return
            wait_s = min(2 * wait_s, _LONGEST_WAIT_S)
            try:
                self._process = self._start()
            except OSError as error:  # for want of memory, say
                self._tell(f"no worker could be started: {error.strerror}")

    def end(self) -> None:
        """End the worker and all its child processes. The next worker begins a job that was killed again."""
        end_with_children(self._process, _GRACE_S)

    def _start(self) -> subprocess.Popen[bytes]:
        # In its own session, so that Ctrl-C reaches only the runner, which ends its worker in an orderly way.
        return subprocess.Popen(
            self._command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, start_new_session=True
        )
