"""The worker process beside a run: it ends with the run, and one that dies is replaced."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

import psutil

_GRACE_S = 10.0
_POLL_S = 0.5
_FIRST_WAIT_S, _LONGEST_WAIT_S = 1.0, 60.0  # before one that died is replaced; doubled each time


@contextmanager
def worker_beside(data: Path, tell: Callable[[str], object]) -> Generator[None]:
    """A worker process that ends with this block, or with this process; `tell` hears when one has died."""
    beside = _Beside(data, tell)
    keeper = threading.Thread(target=beside.keep, name="keeper of the worker", daemon=True)
    keeper.start()
    try:
        yield
    finally:
        beside.over.set()
        keeper.join()
        beside.end()


class _Beside:
    def __init__(self, data: Path, tell: Callable[[str], object]) -> None:
        self.over = threading.Event()
        self._tell = tell
        # The parent's number is told, for a worker that looks who its parent is may look too late.
        words = ["worker", "--data", str(data), "--json", "--parent", str(os.getpid())]
        self._command = [sys.executable, "-m", "service.cli.main", *words]
        self._process = self._start()

    def keep(self) -> None:
        """Look after the worker until `over`. What it computed when it died, its successor begins anew."""
        wait_s = _FIRST_WAIT_S
        while not self.over.wait(_POLL_S):
            status = self._process.poll()
            if status is None:
                continue
            self._tell(f"the worker, which computes, has ended (status {status}); another one is started")
            if self.over.wait(wait_s):
                return
            wait_s = min(2 * wait_s, _LONGEST_WAIT_S)
            try:
                self._process = self._start()
            except OSError as error:  # no memory for it now
                self._tell(f"no worker could be started: {error.strerror}")

    def end(self) -> None:
        """End the worker and all that it has started."""
        self._process.terminate()
        try:
            self._process.wait(timeout=_GRACE_S)
        except subprocess.TimeoutExpired:  # in the middle of a long job, which the next worker begins anew
            for child in (*psutil.Process(self._process.pid).children(recursive=True), self._process):
                child.kill()
            self._process.wait()

    def _start(self) -> subprocess.Popen[bytes]:
        # A session of its own: Ctrl-C is for the runner, which ends its worker in order.
        return subprocess.Popen(
            self._command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, start_new_session=True
        )
