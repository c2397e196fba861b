"""The connection from a program to a driver's process: it carries the requests, and a heartbeat between them.

A separate thread sends the heartbeat, because the main thread can be busy for many seconds (an exposure, storing a
file) while nothing is wrong. The heartbeat proves that the process is alive and running: a process that was killed or
stopped sends none. It does not prove that the main thread still supervises the device. The driver judges that by the
calls it receives: drivers/ur/watchdog.py stops a moving arm whose state nobody has queried for some seconds.
"""

from __future__ import annotations

import selectors
import threading
import time
from multiprocessing.connection import Connection
from typing import Any

BEAT = "heartbeat"  # sent in place of a method name
BEAT_S = 0.04
START_TIMEOUT_S = 60.0  # time to import the driver and its vendor library on a busy machine
CLOSE_TIMEOUT_S = 10.0
MOST_STRETCHED = 4.0  # how many times as long as its limit a call may take on a machine that keeps its driver waiting


class Line:
    """The parent's end of the connection to a driver's process.

    A heartbeat is skipped, not delayed, while the child does not read.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._lock = threading.Lock()  # for sending
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)

    def begin(self) -> None:
        """Send heartbeats from now until `close`."""
        self._thread.start()

    def send(self, request: tuple[int, str, tuple[Any, ...], dict[str, Any]]) -> None:
        """Send a request (sequence number, method, args, kwargs). Raises OSError if the child is gone."""
        with self._lock:
            self._connection.send(request)

    def poll(self, timeout_s: float) -> bool:
        """Wait for an answer; returns whether one arrived within `timeout_s`."""
        return self._connection.poll(timeout_s)

    def receive(self) -> Any:
        """Return the next answer. Raises EOFError or OSError if the child is gone."""
        return self._connection.recv()

    def close(self) -> None:
        """Stop the heartbeat and close the connection, which ends the child."""
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
                        if selector.select(0.0):  # otherwise the child does not read, and the beat would arrive late
                            self._connection.send((0, BEAT, (time.monotonic(),), {}))
                    except OSError:  # the child is gone: the next call reports it
                        return
