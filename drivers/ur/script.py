"""The control interface: its script on the controller, watched from its start to its end, and commands to it."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Generator

from drivers.errors import DeviceError, DeviceTimeoutError, DeviceUnavailableError
from drivers.ur import UrConfig
from drivers.ur import vendor as library
from drivers.ur.latch import Latch
from drivers.ur.link import vendor
from drivers.ur.stream import STREAM_HZ
from drivers.ur.watchdog import Watchdog

SCRIPT_START_S = 5.0
STOP_S = 5.0

_LOG = logging.getLogger(__name__)


class ControlScript:
    """Connected by its first command; sent again after it ended, unless the latch holds the arm."""

    def __init__(self, config: UrConfig, latch: Latch, watchdog: Watchdog) -> None:
        self._config, self._where = config, config.host
        self._latch, self._watchdog = latch, watchdog
        self._control: library.Control | None = None
        self._abandoned: list[library.Control] = []  # kept from their destructors
        self.sent = 0  # how often the script was sent

    @contextlib.contextmanager
    def commanding(self, doing: str, hold: DeviceError | None) -> Generator[library.Control]:
        """The interface with its script running, for commands; raises `hold` instead."""
        with self._watchdog.commanding():
            if hold is not None:
                raise hold
            control = self._running()
            with vendor(self._where, doing):
                yield control

    def _connect(self) -> library.Control:
        """Connect, which sends the script."""
        with self._watchdog.commanding(), vendor(self._where, "starting the control script"):
            self._control = control = library.control(self._config.host, STREAM_HZ)
            self.sent += 1
            self._watchdog.guard(control)
        return control

    def _running(self) -> library.Control:
        control = self._control
        if control is None:
            return self._connect()
        with vendor(self._where, "starting the control script"):
            if not control.isConnected():
                raise DeviceUnavailableError("the control connection is lost", where=self._where, remedy="Reconnect")
            self._watchdog.look()
            if stop := self._latch.stop:
                raise stop
            if not control.isProgramRunning():
                _LOG.info("%s: the control script had ended and is sent again", self._where)
                control.reuploadScript()
                wait(control.isProgramRunning, SCRIPT_START_S, "the control script to start", self._where)
                self.sent += 1
            self._watchdog.guard(control)
        return control

    @property
    def connected(self) -> bool:
        """Whether it has been connected."""
        return self._control is not None

    def moves(self) -> bool:
        """Whether the script reports a motion under way."""
        control = self._control
        with vendor(self._where, "asking for the motion's progress"):
            return (
                control is not None
                and control.isProgramRunning()
                and control.getAsyncOperationProgressEx().isAsyncOperationRunning()
            )

    def stop_motion(self, sees_driven: Callable[[], bool]) -> bool:
        """Stop a motion and wait until the arm stands; False when the script does not run."""
        control = self._control
        with self._watchdog.commanding():
            if control is None or not control.isConnected() or not control.isProgramRunning():
                return False
            control.stopJ(self._config.stop_deceleration_rad_s2, True)
        # The watchdog is kicked while the arm slows down, which a call that waits for its end would prevent.
        wait(lambda: not sees_driven(), STOP_S, "the arm to stand still", self._where)
        self._watchdog.arrive()
        return True

    def end(self) -> None:
        """End the script and the connection, once the arm stands. Raises the vendor's errors."""
        control, self._control = self._control, None
        self._watchdog.release()
        if control is not None:
            if control.isConnected() and control.isProgramRunning():
                control.stopScript()
            control.disconnect()

    def abandon(self) -> None:
        """Let go of a dead link: its calls wait for ever, or crash."""
        control, self._control = self._control, None
        self._watchdog.release()
        if control is not None:
            self._abandoned.append(control)


def wait(done: Callable[[], bool], timeout_s: float, what: str, where: str) -> None:
    """Poll until it is done. Raises DeviceTimeoutError."""
    deadline_s = time.monotonic() + timeout_s
    while not done():
        if time.monotonic() > deadline_s:
            raise DeviceTimeoutError(
                f"waited {timeout_s:g} s for {what}",
                where=where,
                remedy="Look at the pendant for what keeps the controller from it, then try again",
            )
        time.sleep(0.01)
