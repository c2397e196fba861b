"""Threads of the runner's process that go on telling how things stand while its main loop is in a long call."""

from __future__ import annotations

import threading
from collections.abc import Callable


class Heartbeat:
    """Each work is called again and again in a thread of its own: one that waits does not hold up the others."""

    def __init__(self, *works: Callable[[], None], every_s: float = 0.5) -> None:
        self._every_s = every_s
        self._stop = threading.Event()
        self._threads = [
            threading.Thread(target=self._run, args=(work,), name="reporter heartbeat", daemon=True) for work in works
        ]

    def begin(self) -> None:
        """From now on."""
        for thread in self._threads:
            thread.start()

    def end(self, within_s: float = 2.0) -> None:
        """No further call. One that waits for a device is left behind: it ends with the process."""
        self._stop.set()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join(within_s)

    def _run(self, work: Callable[[], None]) -> None:
        while not self._stop.is_set():
            work()
            self._stop.wait(self._every_s)
