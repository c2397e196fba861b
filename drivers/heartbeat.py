"""The line from a program to a driver's process: its requests, and between them a heartbeat.

The beat comes from a thread of its own, for the main thread has calls of many seconds (an exposure, a file to be
stored) in which nothing is wrong. Such a thread proves that the process lives and runs: killed or stopped, it sends
nothing. It does not prove that the main thread still looks after the device. That is for the driver to see from the
calls that reach it: drivers/ur/watchdog.py stops an arm that moves and that nobody has asked about for some seconds.
"""

from __future__ import annotations

import selectors
import threading
import time
from multiprocessing.connection import Connection
from typing import Any

BEAT = "heartbeat"  # in the place of a method's name
BEAT_S = 0.04


class Line:
    """The parent's end of a connection to a driver's process; a beat never waits for a child that does not read."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._lock = threading.Lock()  # of sending
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)

    def begin(self) -> None:
        """Beat from now on until `close`."""
        self._thread.start()

    def send(self, request: tuple[int, str, tuple[Any, ...], dict[str, Any]]) -> None:
        """Send a request. Raises OSError when the child is gone."""
        with self._lock:
            self._connection.send(request)

    def poll(self, timeout_s: float) -> bool:
        """Whether an answer comes in time."""
        return self._connection.poll(timeout_s)

    def receive(self) -> Any:
        """The next answer. Raises EOFError or OSError when the child is gone."""
        return self._connection.recv()

    def close(self) -> None:
        """End the heartbeat and the connection, which ends the child."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join()
        self._connection.close()

    def _run(self) -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(self._connection, selectors.EVENT_WRITE)
            while not self._stop.wait(BEAT_S):
                with self._lock:
                    try:
                        if selector.select(0.0):  # else the child does not read: this beat would wait, and be old
                            self._connection.send((0, BEAT, (time.monotonic(),), {}))
                    except OSError:  # the child is gone: the next call, or the look at it between calls, says so
                        return
