"""Shared by all simulator processes: the ready line, signals, sockets, ending with the parent, the error type."""

from __future__ import annotations

import argparse
import json
import os
import queue
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from types import FrameType

_PARENT_POLL_S = _SLICE_S = 0.5
_REQUEST_POLL_S = 0.2

Json = None | bool | int | float | str | list["Json"] | dict[str, "Json"]


class SimulatorError(Exception):
    """A simulator cannot start or continue, and the message says why. Separate from the service's error tree."""


def announce(**fields: object) -> None:
    """Write the ready line (JSON, with `"ready": true` first) to stdout."""
    sys.stdout.write(json.dumps({"ready": True, **fields}) + "\n")
    sys.stdout.flush()


def wait_for_line() -> bool:
    """Wait for a line on stdin. Returns False at its end: nobody is there to tell any more."""
    return bool(sys.stdin.readline())


def add_patience(parser: argparse.ArgumentParser) -> None:
    """Declare the option of controllers that guard against a dead client."""
    parser.add_argument(
        "--patience",
        type=float,
        default=0.0,
        metavar="S",
        help="no guard against a dead program waits less than this, because the machine has other work too",
    )


class Termination:
    """Set by SIGTERM or SIGINT. Create it in the main thread.

    It is no Event: a handler that sets one waits for ever for its lock if the signal interrupts the main thread while
    that holds the lock within `wait`. A SimpleQueue may be put into from a handler.
    """

    def __init__(self) -> None:
        self._over = False
        self._news: queue.SimpleQueue[None] = queue.SimpleQueue()
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._handle)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        del number, frame
        self.set()

    def set(self) -> None:
        """End the process as SIGTERM would."""
        self._over = True
        self._news.put(None)

    def is_set(self) -> bool:
        """Return whether the process should end."""
        return self._over

    def wait(self, timeout_s: float | None = None) -> bool:
        """Block until the process should end (returns True) or the timeout expires (returns False)."""
        # In slices: a signal that another thread received runs its handler only when the main thread wakes up.
        remaining_s = float("inf") if timeout_s is None else timeout_s
        while not self.is_set():
            if remaining_s <= 0:
                return False
            slice_s = min(_SLICE_S, remaining_s)
            with suppress(queue.Empty):
                self._news.get(timeout=slice_s)
            remaining_s -= slice_s
        return True


class Request:
    """Made by SIGUSR1. Create it in the main thread, before the ready line."""

    def __init__(self) -> None:
        self._made = False
        signal.signal(signal.SIGUSR1, self._handle)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        del number, frame
        self._made = True

    def serve(self, termination: Termination, action: Callable[[], object]) -> None:
        """Do `action` at each request until the termination is set."""
        while not termination.wait(_REQUEST_POLL_S):
            if self._made:
                self._made = False
                action()


def listening(host: str, port: int) -> socket.socket:
    """A listening socket. Raises SimulatorError."""
    try:
        return socket.create_server((host, port), backlog=8)
    except OSError as error:
        raise SimulatorError(f"cannot listen on {host}:{port}: {error.strerror}") from error


def end_with(parent: int) -> None:
    """Send this process SIGTERM as soon as `parent` (a process id) is no longer its parent.

    The parent states its own id: a process that asks for it may ask after the parent has died.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_PARENT_POLL_S)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, name="parent", daemon=True).start()
