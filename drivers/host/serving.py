"""The child's side of a hosted driver: it serves one driver over a descriptor (`python -m drivers.host FD NOTE`)."""

from __future__ import annotations

import contextlib
import faulthandler
import importlib
import logging
import os
import pickle
import queue
import signal
import sys
import threading
import time
from multiprocessing.connection import Connection
from typing import Any, cast

from drivers.errors import DeviceFaultError
from drivers.host.doing import leave_out, take_note
from drivers.host.heartbeat import BEAT, CLOSE_TIMEOUT_S, MOST_STRETCHED, START_TIMEOUT_S
from drivers.interfaces import Answering, Device, answers_of
from drivers.plugin import DriverSpec, NeedsHeartbeat
from service.core.errors import ConfigurationError, OrthocaptureError
from service.core.loading import loading

SELF_DESTRUCT_GRACE_S = 5.0

_LOG = logging.getLogger("drivers.host")


class _Server:
    """Runs the driver's methods one at a time in the main thread; a second thread reads the connection."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._requests: queue.SimpleQueue[tuple[int, str, tuple[Any, ...], dict[str, Any]] | None]
        self._requests = queue.SimpleQueue()
        self._device: Device | None = None
        self._call_timeout_s = START_TIMEOUT_S

    def serve(self) -> None:
        """Serve requests until the parent closes the connection or dies; then exit the process."""
        threading.Thread(target=self._read, daemon=True).start()
        while (request := self._requests.get()) is not None:
            sequence, method, args, kwargs = request
            # A vendor call may hold the GIL for ever while the parent is gone: the default action of SIGALRM
            # ends this process without any help from Python. A parent that lives has given up before.
            signal.setitimer(signal.ITIMER_REAL, MOST_STRETCHED * self._call_timeout_s + SELF_DESTRUCT_GRACE_S)
            reply = self._answer(sequence, method, args, kwargs)
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # the reader thread ends the process
                self._connection.send_bytes(reply)
        if self._device is not None:
            self._device.close()
        logging.shutdown()
        os._exit(0)  # skip the destructors of native libraries, which may wait for a dead link

    def _read(self) -> None:
        try:
            while True:
                request = cast("tuple[int, str, tuple[Any, ...], dict[str, Any]]", self._connection.recv())
                if request[1] != BEAT:
                    self._requests.put(request)
                elif isinstance(self._device, NeedsHeartbeat):
                    self._device.heartbeat(*request[2])
        except (EOFError, OSError):
            self._requests.put(None)
        time.sleep(CLOSE_TIMEOUT_S)
        os._exit(1)  # the main thread is stuck in the driver

    def _answer(self, sequence: int, method: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> bytes:
        try:
            return pickle.dumps((sequence, True, self._run(method, args, kwargs)))
        except OrthocaptureError as error:
            return pickle.dumps((sequence, False, error))
        except Exception as error:  # noqa: BLE001 - the one place where vendor exceptions of any type must stop
            _LOG.warning("%s raised", method, exc_info=True)
            what = f"driver raised {type(error).__name__} in {method}: {error}"
            fault = DeviceFaultError(
                what, where=type(self._device).__name__, remedy="See the log of the driver process"
            )
            return pickle.dumps((sequence, False, fault))

    def _run(self, method: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        if method == "":
            return None
        if method == "start":
            spec_path, config_json, self._call_timeout_s, ended = cast("tuple[str, str, float, frozenset[str]]", args)
            leave_out(ended)
            with loading():
                spec = load_spec(spec_path)
                self._device = spec.build(spec.config.model_validate_json(config_json))
            return isinstance(self._device, NeedsHeartbeat)
        if method == Answering.answers.__name__:
            return answers_of(self._device)
        return getattr(self._device, method)(*args, **kwargs)


def load_spec(spec_path: str) -> DriverSpec:
    """Import the DriverSpec named "module:ATTRIBUTE". Raises ConfigurationError if there is none."""
    module_name, _, attribute = spec_path.partition(":")
    try:
        spec = getattr(importlib.import_module(module_name), attribute, None)
    except ImportError as error:
        raise ConfigurationError(
            f"driver cannot be imported: {error}", where=spec_path, remedy="Install what the driver needs"
        ) from error
    if not isinstance(spec, DriverSpec):
        raise ConfigurationError("this is not a DriverSpec", where=spec_path, remedy="See drivers/plugin.py")
    return spec


def main() -> None:
    """Entry point of the child; its arguments are the file descriptors of the connection and of the note."""
    faulthandler.enable()
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(levelname)s|%(name)s: %(message)s")
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    take_note(int(sys.argv[2]))
    _Server(Connection(int(sys.argv[1]))).serve()
