"""Forwards the runner's heartbeat to the controller's own watchdog, which stops the arm when the heartbeat ends.

Each heartbeat of the program that uses the arm becomes one kick; the driver adds no timer of its own. If that
program, this process or the network dies or hangs, the kicks end, and the controller stops the arm by itself.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Generator

from drivers.arm.latch import Latch
from drivers.arm.stream import driven
from drivers.interfaces import RobotSample
from drivers.ur import vendor as library
from drivers.ur.link import VENDOR_ERRORS

LATE = 0.8  # fraction of the watchdog's timeout; a longer gap between kicks explains why the program ended
LAPSE_S = 2.0  # longest gap that counts as a busy machine if the arm stood still
NEWS_S = 1.0  # time after a gap for the controller's reaction to become visible here

_LOG = logging.getLogger(__name__)


class Watchdog:
    """Kicks the watchdog of the control script from a thread, once per heartbeat.

    Args:
        latch: told when the control script ended unexpectedly.
        watchdog_s: timeout of the controller's watchdog.
        unattended_s: time after which the kicks stop for a moving arm whose state nobody has queried.
        newest: returns the newest sample of the arm, or None if the stream is dead.
    """

    def __init__(
        self, latch: Latch, *, watchdog_s: float, unattended_s: float, newest: Callable[[], RobotSample | None]
    ) -> None:
        self._commands = threading.RLock()
        self._latch = latch
        self._watchdog_s, self._unattended_s = watchdog_s, unattended_s
        self._newest = newest
        self._control: library.Control | None = None
        self._beaten = threading.Event()
        self._beat_s = self._kicked_s = self._attended_s = self._gap_end_s = -float("inf")
        self._gap_s = 0.0  # the last gap that was too long; it ended at _gap_end_s
        self._moving = False
        self._left_alone = self._lapsed = False
        threading.Thread(target=self._run, name="ur watchdog", daemon=True).start()

    def beat(self, sent_monotonic_s: float) -> None:
        """Receive a heartbeat of the program that uses the arm, with the host time.monotonic() of its sending."""
        self._beat_s = sent_monotonic_s
        self._beaten.set()

    @contextlib.contextmanager
    def commanding(self) -> Generator[None]:
        """Block kicks while the control interface is given commands: a kick before the answer would lose the answer.

        A command counts as a kick too, because it writes the same register.
        """
        with self._commands:
            yield
            self._note_kick()

    def guard(self, control: library.Control) -> None:
        """Start the watchdog of the running control script, unless it runs already. Raises the vendor's errors."""
        with self._commands:
            if self._control is not None:
                return
            if not control.setWatchdog(1.0 / self._watchdog_s):
                raise RuntimeError("the control script did not accept its watchdog")
            self._kicked_s, self._gap_s = time.monotonic(), 0.0
            self._control = control
            self._lapsed = False

    @property
    def guarding(self) -> bool:
        """Return whether a control script is guarded: it runs, as far as is known."""
        return self._control is not None

    def release(self) -> None:
        """Stop guarding the script, because it is about to be ended on purpose."""
        with self._commands:
            self._control = None
            self._moving = False

    def excuse(self) -> None:
        """Handle a failed command: if the script ended, the command caused it, unless the kicks came late."""
        with self._commands:
            control = self._control
            if control is None or control.isProgramRunning():
                return
            if self._unkicked_s() > LATE * self._watchdog_s:
                self.look()
            self.release()

    def begin(self) -> None:
        """Note that a motion is about to begin."""
        self.attend()
        self._moving = True

    def arrive(self) -> None:
        """Note that the motion has ended normally."""
        self._moving = False

    @property
    def moving(self) -> bool:
        """Return whether a motion was started whose end has not been observed yet."""
        return self._moving

    def attend(self) -> None:
        """Note that the program has queried the arm, so its main loop is alive too."""
        self._attended_s = time.monotonic()

    def look(self) -> None:
        """Check whether the guarded script has ended, and why; latches the arm if it ended unexpectedly.

        Raises the vendor's errors.
        """
        with self._commands:
            control = self._control
            if control is None or control.isProgramRunning():
                return
            late_s = self._unkicked_s()
            self._control = None
            late = late_s > LATE * self._watchdog_s
            if not self._moving and late and late_s < LAPSE_S:
                _LOG.info("the control script ended while the arm stood: no kick for %.2f s", late_s)
                self._lapsed = True
                return
            if self._left_alone:
                what = f"the arm was stopped: nobody had looked at it for {self._unattended_s:g} s"
            elif late:
                what = f"the arm was stopped: the program that drives it gave no sign of life for {late_s:.1f} s"
            else:
                what = "the arm was stopped: its program was ended at the controller"
            self._latch.end(what)

    def lapsed(self) -> bool:
        """Return whether the script ended while the arm stood still, because this machine was briefly busy.

        Raises the vendor's errors.
        """
        with self._commands:
            self.look()
            return self._lapsed

    def _run(self) -> None:
        while True:
            self._beaten.wait()
            self._beaten.clear()
            # A command in progress is a kick too, and the next beat comes soon.
            if self._commands.acquire(timeout=self._watchdog_s / 4):
                try:
                    self._kick()
                except VENDOR_ERRORS as error:
                    _LOG.warning("kicking the watchdog failed: %s", error)
                finally:
                    self._commands.release()

    def _kick(self) -> None:
        control, sample, now_s = self._control, self._newest(), time.monotonic()
        # On a dead link the vendor's calls hang; a beat that waited in a queue does not prove life.
        if control is None or sample is None or now_s - self._beat_s > self._watchdog_s or not control.isConnected():
            return
        self.look()
        if self._control is None:
            return
        unattended_s = now_s - self._attended_s
        self._left_alone = self._moving and driven(sample) and unattended_s > self._unattended_s
        if not self._left_alone and control.kickWatchdog():
            self._note_kick()

    def _note_kick(self) -> None:
        now_s = time.monotonic()
        if now_s - self._kicked_s > LATE * self._watchdog_s:
            self._gap_s, self._gap_end_s = now_s - self._kicked_s, now_s
        self._kicked_s = now_s

    def _unkicked_s(self) -> float:
        """Seconds without a kick, or the length of a recent gap whose effect may not be visible here yet."""
        now_s = time.monotonic()
        return max(now_s - self._kicked_s, self._gap_s if now_s - self._gap_end_s < NEWS_S else 0.0)
