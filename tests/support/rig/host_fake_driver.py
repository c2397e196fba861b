"""A driver that misbehaves on request, for the tests of drivers.host."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Protocol

import numpy as np

from drivers.errors import DeviceRefusedError, DeviceUnavailableError, SafetyStopError
from drivers.host.doing import doing
from drivers.interfaces import Array, Device, DeviceIdentity, DeviceReport
from drivers.plugin import DriverConfig, DriverSpec


class FakeConfig(DriverConfig):
    """The file that `close` writes, and the word that `report` returns."""

    word: str = "hello"
    trace: Path | None = None
    die_on_open: bool = False
    bad_value: str = ""  # which `open` reads, and which crashes or hangs: `crash` or `hang`
    report_s: float = 0.0  # how long `report` takes
    hangs: Path | None = None  # made when `hang` begins


class Fake(Device, Protocol):
    """The kinds of misbehaviour."""

    def double(self, values: Array, *, offset: float = 0.0) -> Array: ...
    def crash(self, signal_number: int) -> None: ...
    def crash_later(self, delay_s: float) -> None: ...
    def read_value(self, how: str) -> str: ...
    def hang(self, seconds: float) -> None: ...
    def burn(self, processor_s: float) -> None: ...
    def hear(self, count: int) -> None: ...
    def refuse(self) -> None: ...
    def lose_link(self) -> None: ...
    def blunder(self) -> None: ...
    def unpicklable(self) -> object: ...
    def talk(self) -> None: ...
    def stdin_target(self) -> str: ...
    def beats(self) -> tuple[tuple[float, float], ...]: ...


class FakeDriver:
    """Implements Fake."""

    def __init__(self, config: FakeConfig) -> None:
        self._config = config
        self._opened = 0
        self._beats: list[tuple[float, float]] = []

    def heartbeat(self, sent_monotonic_s: float) -> None:
        self._beats.append((sent_monotonic_s, time.monotonic()))

    def beats(self) -> tuple[tuple[float, float], ...]:
        """When each heartbeat was sent and when it arrived, since the last call."""
        beats, self._beats = self._beats, []
        return tuple(beats)

    def open(self) -> DeviceIdentity:
        if self._config.die_on_open:
            os._exit(3)
        if self._config.bad_value:
            self.read_value(self._config.bad_value)
        self._opened += 1
        return DeviceIdentity("fake", self._config.word, str(os.getpid()), str(self._opened), "fake", "1", "here")

    def close(self) -> None:
        if self._config.trace is not None:
            self._config.trace.write_text("closed")

    def report(self) -> DeviceReport:
        time.sleep(self._config.report_s)
        return DeviceReport(self.open())

    def double(self, values: Array, *, offset: float = 0.0) -> Array:
        return np.asarray(2 * values + offset)

    def crash(self, signal_number: int) -> None:
        os.kill(os.getpid(), signal_number)
        time.sleep(5)

    def read_value(self, how: str) -> str:
        """Read a value on which a library crashes or hangs; "left out" where the host refuses to."""
        try:
            with doing("Reading the setting iso", optional=True):
                self.hang(600) if how == "hang" else self.crash(signal.SIGSEGV)
        except DeviceRefusedError as error:
            return error.what
        return "read"

    def crash_later(self, delay_s: float) -> None:
        subprocess.Popen([sys.executable, "-c", f"import os,time; time.sleep({delay_s}); os.kill({os.getpid()}, 11)"])

    def lose_link(self) -> None:
        raise DeviceUnavailableError("the controller does not answer", where="here")

    def hang(self, seconds: float) -> None:
        if self._config.hangs is not None:
            self._config.hangs.touch()
        time.sleep(seconds)

    def burn(self, processor_s: float) -> None:
        """Compute for so long, by the processor's time."""
        ends_s = time.thread_time() + processor_s
        while time.thread_time() < ends_s:
            pass

    def hear(self, count: int) -> None:
        """Return when so many more heartbeats have arrived."""
        enough = len(self._beats) + count
        while len(self._beats) < enough:
            time.sleep(0.01)

    def refuse(self) -> None:
        raise SafetyStopError("protective stop", where="joint 3", remedy="Clear the cause")

    def blunder(self) -> None:
        class VendorError(Exception):
            pass

        raise VendorError("the vendor says -7")

    def unpicklable(self) -> object:
        return lambda: None

    def talk(self) -> None:
        os.write(1, b"vendor chatter on stdout\n")
        logging.getLogger(__name__).warning("the driver warns")
        logging.getLogger("pydicom").warning("words of a library")

    def stdin_target(self) -> str:
        return os.readlink("/proc/self/fd/0")


DRIVER = DriverSpec(kind="fake", config=FakeConfig, build=FakeDriver, hosted=True)
NOT_A_DRIVER = signal.SIGTERM
