"""The parent's side of a hosted driver: a supervised child process (call timeout, heartbeat, restart).

It contains native crashes of vendor libraries.
"""

from __future__ import annotations

import logging
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from subprocess import DEVNULL, PIPE, STDOUT, Popen, TimeoutExpired
from typing import Any, Literal, TypeVar, cast

from pydantic import BaseModel

from drivers.errors import (
    DeviceError,
    DeviceTimeoutError,
    DeviceUnavailableError,
    DriverKilledError,
    MachineBusyError,
)
from drivers.host.doing import MOST_ENDS, Note
from drivers.host.heartbeat import CLOSE_TIMEOUT_S, MOST_STRETCHED, START_TIMEOUT_S, Line
from drivers.interfaces import Answering, DeviceIdentity
from drivers.machine_pressure import HeldUp, killed_for_memory
from drivers.plugin import READING_TIMEOUT_S
from service.core.errors import OrthocaptureError

_LOG = logging.getLogger("drivers.host")
_LEVELS = logging.getLevelNamesMapping()
# What other libraries than the driver's own package log in a child is for the log file, not for people.
_OURS = frozenset({"drivers", "service", "root"})
T = TypeVar("T")
# The driver's process died, did not answer, or has told that the device does not.
Ending = Literal["died", "stalled", "broken"]
OnEnd = Callable[[Ending, DeviceError], None]

PING_TIMEOUT_S = 15.0
_READING = frozenset({"report", "settings"})  # calls that only read what the device knows
# Of these a process does not die by a fault of its own: the system or a person sends them.
_FROM_OUTSIDE = frozenset({signal.SIGKILL, signal.SIGALRM, signal.SIGTERM, signal.SIGXCPU})
_PROMPT_S = 0.1
_LOOK_S = 0.2  # how often a late call's process is looked at: a wait that goes on counts from the first look
_WORTH_WAITING_S = 0.02
_BUSY_SHARE = 0.25  # of a call's time limit; held up for longer, the driver is not to blame


def hosted(
    interface: type[T],
    spec_path: str,
    config: BaseModel,
    *,
    call_timeout_s: float,
    name: str,
    reading_timeout_s: float = READING_TIMEOUT_S,
    on_end: OnEnd = lambda _how, _error: None,
) -> T:
    """Return a proxy with the public methods of `interface` and `answers`; each call runs in the driver's process.

    Args:
        interface: RobotArm, Camera, … (a Protocol derived from Device).
        spec_path: entry point of the driver, "module:ATTRIBUTE" naming a DriverSpec.
        config: the validated configuration; the child validates its JSON again.
        call_timeout_s: longest time that one call may take before the child is killed, not counting the time in
            which the machine kept it from running, up to MOST_STRETCHED times as long in all.
        name: the device's name in rig.yaml, for messages and logs.
        reading_timeout_s: the same for `report` and `settings`, if shorter.
        on_end: called by any thread when the connection to a device that was open has ended; must return at once.

    `open()` starts the child, and restarts it after it died. Methods raise only OrthocaptureError.
    """
    device = HostedDevice(
        spec_path,
        config,
        call_timeout_s=call_timeout_s,
        name=name,
        reading_timeout_s=reading_timeout_s,
        on_end=on_end,
    )
    methods: dict[str, Any] = {"__init__": _keep_device, "__doc__": f"{interface.__name__} in a process of its own."}
    for base in (Answering, *reversed(interface.__mro__)):
        for method, function in vars(base).items():
            if not method.startswith("_") and callable(function):
                methods[method] = _forwarder(method, function)
    return cast("T", type(f"Hosted{interface.__name__}", (), methods)(device))


def _keep_device(proxy: Any, device: HostedDevice) -> None:
    proxy.hosted_device = device


def _forwarder(method: str, function: Callable[..., Any]) -> Callable[..., Any]:
    def forward(proxy: Any, *args: Any, **kwargs: Any) -> Any:
        device: HostedDevice = proxy.hosted_device
        if method == "open":
            return device.open()
        if method == "close":
            return device.close()
        return device.call(method, *args, **kwargs)

    forward.__name__ = method
    forward.__doc__ = function.__doc__
    return forward


class _NoAnswerError(Exception):
    """The child did not answer in time, of which the machine had held it up for `held_up_s`."""

    def __init__(self, held_up_s: float) -> None:
        super().__init__(held_up_s)
        self.held_up_s = held_up_s


@dataclass(frozen=True, slots=True)
class _Child:
    """A running child process, with the parent's end of its connection and of its log."""

    process: Popen[str]
    line: Line
    log_reader: threading.Thread


class HostedDevice:
    """The parent's side: starts the child, calls it, kills it when it does not answer, and reports how it ended."""

    def __init__(
        self,
        spec_path: str,
        config: BaseModel,
        *,
        call_timeout_s: float,
        name: str,
        heartbeat_s: float = 5.0,
        reading_timeout_s: float = READING_TIMEOUT_S,
        on_end: OnEnd = lambda _how, _error: None,
    ) -> None:
        self._spec_path = spec_path
        self._config_json = config.model_dump_json()
        self._call_timeout_s = call_timeout_s
        self._reading_timeout_s = min(call_timeout_s, reading_timeout_s)
        self._name = name
        self._heartbeat_s = heartbeat_s
        self._lock = threading.RLock()
        self._child: _Child | None = None
        self._sequence = 0
        self._obituary = "not opened yet"
        self._note = Note()
        self._method = ""  # the call in progress
        self._crashed = False  # the last child died of a fault of its own
        self._killed = False  # the last child died of a signal from outside
        self._memory_kills = 0  # of the kernel, when the child began
        self._suspect = False  # the driver reported a lost link
        self._on_end = on_end
        self._opened = False  # in this child
        self._watch_stop = threading.Event()
        self._watcher: threading.Thread | None = None

    @property
    def pid(self) -> int | None:
        """Process id of the child; None if none is running."""
        child = self._child
        return child.process.pid if child else None

    def open(self) -> DeviceIdentity:
        """Start the child unless one is alive, open the device in it and return its identity.

        Raises DeviceError as `call` does, and ConfigurationError if the driver cannot be loaded.
        """
        with self._lock:
            if self._child is not None and (self._suspect or self._child.process.poll() is not None):
                self._bury()  # do not reconnect within a native library that has lost its link
            fresh = self._child is None
            if fresh:
                self._start()
            # The rest of an old connection may crash the child, and so may a value that the device states; a new
            # child starts clean, and leaves out what has crashed twice.
            for attempt in range(MOST_ENDS + 1):
                try:
                    identity = cast("DeviceIdentity", self.call("open"))
                except DeviceError as error:
                    if self._child is not None or isinstance(error, DriverKilledError):
                        raise
                    again = (attempt == 0 and not fresh) or (self._crashed and bool(self._note.read()))
                    if attempt == MOST_ENDS or not again:
                        raise
                    _LOG.warning("%s: %s; trying once more", self._name, error)
                    self._start()
                else:
                    self._opened = True
                    return identity
            raise AssertionError

    def close(self) -> None:
        """Close the device and end the child; does not raise if either is already gone."""
        with self._lock:
            if self._child is None:
                return
            try:
                self._exchange("close", (), {}, CLOSE_TIMEOUT_S)
            except DeviceError as error:
                _LOG.warning("%s: closing: %s", self._name, error)
            self._bury()
            self._obituary, self._killed = "closed", False
        self._watch_stop.set()

    def call(self, method: str, *args: Any, **kwargs: Any) -> Any:
        """Run one method of the driver in the child and return its result.

        Raises:
            OrthocaptureError: the driver raised it.
            DeviceFaultError: the driver raised any other exception.
            DeviceTimeoutError: no answer within the call timeout; the child was killed.
            MachineBusyError: the same, and the machine had kept the child from running.
            DriverKilledError: the child was ended from outside, such as by the kernel for want of memory.
            DeviceUnavailableError: the child is not running.
        """
        with self._lock:
            longest_s = self._reading_timeout_s if method in _READING else self._call_timeout_s
            return self._exchange(method, args, kwargs, longest_s)

    # --- conversation --------------------------------------------------------------------------------

    def _exchange(self, method: str, args: tuple[Any, ...], kwargs: dict[str, Any], timeout_s: float) -> Any:
        child = self._child
        if child is None:
            raise self._unavailable()
        self._sequence += 1
        self._method = method
        try:
            child.line.send((self._sequence, method, args, kwargs))
            ok, value = self._receive(child, timeout_s)
        except _NoAnswerError as silence:
            child.process.kill()
            opened = self._bury()
            self._killed = False
            stalled = _stalled(method or "ping", timeout_s, silence.held_up_s, self._name, self._doing())
            self._obituary = f"killed after {method or 'ping'} did not return within {timeout_s:g} s{self._doing()}"
            if isinstance(stalled, DeviceTimeoutError):
                self._note.count_end()
            if opened:
                self._on_end("stalled", stalled)
            raise stalled from None
        except (EOFError, OSError) as error:
            opened = self._bury()
            died = self._unavailable()
            if opened:
                self._on_end("died", died)
            raise died from error
        if not ok:
            if isinstance(value, DeviceUnavailableError) and not self._suspect:
                self._suspect = True
                if self._opened:
                    self._on_end("broken", value)
            raise value
        return value

    def _receive(self, child: _Child, timeout_s: float) -> tuple[bool, Any]:
        """The answer to the last request; the time in which the machine held the child up does not count.

        Raises _NoAnswerError, EOFError, OSError.
        """
        began_s = time.monotonic()
        held_up: HeldUp | None = None  # measured only where an answer is late: there are hundreds in a second
        deadline_s = began_s + min(timeout_s / 2, _PROMPT_S)
        while True:
            left_s = deadline_s - time.monotonic()
            if child.line.poll(max(0.0, left_s if held_up is None else min(left_s, _LOOK_S))):
                sequence, ok, value = cast("tuple[int, bool, Any]", child.line.receive())
                if sequence == self._sequence:  # older answers belong to calls that Ctrl-C interrupted
                    return ok, value
                continue
            held_up = held_up or HeldUp(child.process.pid)
            if time.monotonic() < deadline_s:
                held_up.look()
                continue
            longest_s = min(timeout_s + held_up.seconds, MOST_STRETCHED * timeout_s)
            if began_s + longest_s <= deadline_s + _WORTH_WAITING_S:
                raise _NoAnswerError(held_up.seconds)
            deadline_s = began_s + longest_s

    def _doing(self) -> str:
        what = self._note.read()
        return f", while {what[0].lower()}{what[1:]}" if what else ""

    def _unavailable(self) -> DeviceUnavailableError:
        if self._killed:
            short = killed_for_memory() > self._memory_kills
            by = "the system ended it for want of memory" if short else "it was ended from outside"
            return DriverKilledError(
                f"driver process is not running: {self._obituary}; {by}",
                where=self._name,
                remedy="End programs that are not needed on this computer, look at the device, then try again",
            )
        remedy = "Open the device again"
        if (what := self._note.read()) in self._note.left_out:
            remedy += f"; {what[0].lower()}{what[1:]} is then left out if the device can do without it"
        return DeviceUnavailableError(
            f"driver process is not running: {self._obituary}", where=self._name, remedy=remedy
        )

    # --- birth and death -----------------------------------------------------------------------------

    def _start(self) -> None:
        ours, theirs = socket.socketpair()
        path = os.pathsep.join(p for p in sys.path if p)
        self._killed, self._memory_kills = False, killed_for_memory()
        self._note.clear()
        try:
            process = Popen(
                [sys.executable, "-m", "drivers.host", str(theirs.fileno()), str(self._note.descriptor)],
                stdin=DEVNULL,  # libgphoto2 closes descriptor 0
                stdout=PIPE,
                stderr=STDOUT,
                pass_fds=[theirs.fileno(), self._note.descriptor],
                env={**os.environ, "PYTHONPATH": path, "PYTHONUNBUFFERED": "1"},
                start_new_session=True,  # Ctrl-C must reach only the parent, which then closes the device properly
                text=True,
                errors="replace",
            )
        except OSError as error:
            ours.close()
            raise MachineBusyError(
                f"the driver's process cannot be started: {error.strerror}",
                where=self._name,
                remedy="End programs that are not needed on this computer, then try again",
            ) from error
        finally:
            theirs.close()
        package = self._spec_path.partition(".")[0].partition(":")[0]
        reader = threading.Thread(target=_pass_on, args=(process, self._name, package), daemon=True)
        reader.start()
        self._child = _Child(process, Line(Connection(ours.detach())), reader)
        self._suspect = False
        start = (self._spec_path, self._config_json, self._call_timeout_s, self._note.left_out)
        try:
            if self._exchange("start", start, {}, START_TIMEOUT_S):
                self._child.line.begin()
        except OrthocaptureError:
            self._bury()
            raise
        self._watch_stop = threading.Event()
        self._watcher = threading.Thread(target=self._watch, args=(self._watch_stop,), daemon=True)
        self._watcher.start()

    def _bury(self) -> bool:
        """End the child; whether the device was open in it."""
        child, self._child = self._child, None
        opened, self._opened = self._opened, False
        if child is None:
            return False
        child.line.close()  # the child exits when its connection closes
        try:
            status = child.process.wait(CLOSE_TIMEOUT_S)
        except TimeoutExpired:
            child.process.kill()
            status = child.process.wait()
        child.log_reader.join(CLOSE_TIMEOUT_S)
        if child.process.stdout is not None:
            child.process.stdout.close()
        self._killed = status < 0 and -status in _FROM_OUTSIDE
        self._obituary = f"died of {signal.Signals(-status).name}" if status < 0 else f"exited with status {status}"
        self._crashed = status < 0 and not self._killed
        if self._crashed:
            self._obituary += f" in {self._method}{self._doing()}" if self._method else ""
            self._note.count_end()
        if status != 0:
            _LOG.error("%s: driver process %d %s", self._name, child.process.pid, self._obituary)
        self._watch_stop.set()
        return opened

    def _watch(self, stop: threading.Event) -> None:
        """Ping the child between calls, so that the log shows when it died or hung."""
        while not stop.wait(self._heartbeat_s):
            if not self._lock.acquire(blocking=False):
                continue  # a call is in progress and has its own timeout
            try:
                if not stop.is_set():
                    self._exchange("", (), {}, PING_TIMEOUT_S)
            except DeviceError as error:
                _LOG.error("%s: heartbeat: %s", self._name, error)
                return
            finally:
                self._lock.release()


def _stalled(method: str, timeout_s: float, lost_s: float, name: str, doing: str) -> DeviceError:
    """Why a call was given up, after the machine had held the driver up for `lost_s`."""
    said = f"driver call {method} did not return within {timeout_s:g} s{doing}"
    if lost_s > _BUSY_SHARE * timeout_s:
        return MachineBusyError(
            f"{said}, nor in the {lost_s:.0f} s more in which it had waited for a processor or for memory; its "
            "process was ended",
            where=name,
            remedy="End what else this computer computes, or wait until it is done; then try again",
        )
    return DeviceTimeoutError(
        f"{said}; its process was ended", where=name, remedy="Check the device and its cable, then open it again"
    )


def _pass_on(process: Popen[str], name: str, package: str) -> None:
    """Log each line that the process writes, until it ends; `package` is that of its driver."""
    log = logging.getLogger(f"{_LOG.name}.{name}")
    assert process.stdout is not None
    for line in process.stdout:
        level, separator, message = line.rstrip().partition("|")
        if separator and level in _LEVELS:
            ours = message.partition(":")[0].partition(".")[0] in _OURS | {package}
            log.log(_LEVELS[level] if ours else min(_LEVELS[level], logging.INFO), "%s", message)
        elif line.strip():
            log.info("%s", line.rstrip())
