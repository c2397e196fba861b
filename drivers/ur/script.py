"""The control interface: sends the control script to the controller, supervises it and gives it commands."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Generator

from drivers.arm.latch import Latch
from drivers.arm.stream import STREAM_HZ
from drivers.errors import DeviceError, DeviceRefusedError, DeviceTimeoutError, DeviceUnavailableError
from drivers.ur import UrConfig
from drivers.ur import vendor as library
from drivers.ur.link import vendor
from drivers.ur.registers import IN_USE, registers_refused
from drivers.ur.watchdog import Watchdog

SCRIPT_START_S = 5.0
STOP_S = 5.0

_LOG = logging.getLogger(__name__)


class ControlScript:
    """The control script on the controller.

    The first command connects and sends it. It is sent again after it ended, unless the latch holds the arm.

    Args:
        config: the arm's configuration.
        latch: holds the arm after a stop.
        watchdog: guards the script.
        end_others: ends another program that runs at the controller. Raises DeviceError.
    """

    def __init__(self, config: UrConfig, latch: Latch, watchdog: Watchdog, *, end_others: Callable[[], None]) -> None:
        self._config, self._where = config, config.host
        self._latch, self._watchdog, self._end_others = latch, watchdog, end_others
        self._control: library.Control | None = None
        self._abandoned: list[library.Control] = []  # kept so that their destructors never run
        self._coming = False  # it was sent again, and was not seen to run yet
        self.sent = 0  # number of times the script was sent

    @contextlib.contextmanager
    def commanding(self, doing: str, hold: DeviceError | None) -> Generator[library.Control]:
        """Yield the control interface with its script running, for commands.

        Args:
            doing: the commands' purpose, for error messages.
            hold: why the arm may not be commanded; raised if not None.
        """
        with self._watchdog.commanding():
            if hold is not None:
                raise hold
            control = self._running()
            with vendor(self._where, doing):
                yield control

    def _connect(self) -> library.Control:
        """Connect to the controller, which also sends the script.

        Raises DeviceRefusedError if its registers are used by somebody else.
        """
        upper = self._config.upper_registers
        self._end_others()
        with self._watchdog.commanding(), vendor(self._where, "starting the control script"):
            try:
                self._control = control = library.control(self._config.host, STREAM_HZ, upper_registers=upper)
            except RuntimeError as error:
                if IN_USE not in str(error):
                    raise
                raise registers_refused(self._where, self._config.connect_timeout_s, upper=upper) from error
            self.sent += 1
            self._coming = True
            self._watchdog.guard(control)
            self._coming = False
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
            runs = control.isProgramRunning()
            if runs and not (self._watchdog.guarding or self._coming):
                raise DeviceRefusedError(
                    "another program runs at the controller",
                    where=self._where,
                    remedy="End it on the pendant, then try again",
                )
            if not runs:
                _LOG.info("%s: the control script had ended and is sent again", self._where)
                self._coming = True
                control.reuploadScript()
                wait(control.isProgramRunning, SCRIPT_START_S, "the control script to start", self._where)
                self.sent += 1
            self._watchdog.guard(control)
            self._coming = False
        return control

    @property
    def connected(self) -> bool:
        """Return whether the control interface has been connected."""
        return self._control is not None

    def moves(self) -> bool:
        """Return whether the script reports a motion in progress."""
        control = self._control
        with vendor(self._where, "asking for the motion's progress"):
            return (
                control is not None
                and control.isProgramRunning()
                and control.getAsyncOperationProgressEx().isAsyncOperationRunning()
            )

    def stop_motion(self, sees_driven: Callable[[], bool]) -> bool:
        """Stop the motion and wait until the arm stands still.

        Args:
            sees_driven: whether the newest sample shows the controller driving the arm.

        Returns False if the script does not run; raises DeviceTimeoutError if the arm does not come to rest.
        """
        control = self._control
        with self._watchdog.commanding():
            if control is None or not control.isConnected() or not control.isProgramRunning():
                return False
            control.stopJ(self._config.stop_deceleration_rad_s2, True)
        # Asynchronous, since a blocking call would prevent watchdog kicks while the arm decelerates.
        wait(lambda: not sees_driven(), STOP_S, "the arm to stand still", self._where)
        self._watchdog.arrive()
        return True

    def end(self) -> None:
        """End the script and the connection; the arm must stand still. Raises the vendor's errors."""
        control, self._control = self._control, None
        self._watchdog.release()
        if control is not None:
            if control.isConnected() and control.isProgramRunning():
                control.stopScript()
            control.disconnect()

    def abandon(self) -> None:
        """Drop a dead link without calling it: its calls would hang or crash."""
        control, self._control = self._control, None
        self._watchdog.release()
        if control is not None:
            self._abandoned.append(control)


def wait(done: Callable[[], bool], timeout_s: float, what: str, where: str) -> None:
    """Poll `done` until it is true; raises DeviceTimeoutError with `what` and `where` after `timeout_s`."""
    deadline_s = time.monotonic() + timeout_s
    while not done():
        if time.monotonic() > deadline_s:
            raise DeviceTimeoutError(
                f"waited {timeout_s:g} s for {what}",
                where=where,
                remedy="Check the pendant for the reason, then try again",
            )
        time.sleep(0.01)
