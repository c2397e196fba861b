"""Threads in the runner's process that keep reporting while its main loop is in a long call."""

from __future__ import annotations

import threading
from collections.abc import Callable

from service.store.durable_effects import Clock


class Heartbeat:
    """Calls each function repeatedly in a thread of its own, so that one that blocks does not hold up the others."""

    def __init__(self, clock: Clock, *works: Callable[[], None], every_s: float = 0.5) -> None:
        self._every_s = every_s
        self._stop = clock.signal()
        self._threads = [
            threading.Thread(target=self._run, args=(work,), name="reporter heartbeat", daemon=True) for work in works
        ]

    def begin(self) -> None:
        """Start the threads."""
        for thread in self._threads:
            thread.start()

    def end(self, within_s: float = 2.0) -> None:
        """Make no further calls. A thread blocked by a device is left behind and ends with the process."""
        self._stop.set()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join(within_s)

    def _run(self, work: Callable[[], None]) -> None:
        while not self._stop.is_set():
            work()
            self._stop.wait(self._every_s)
