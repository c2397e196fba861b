"""Hands the runner's heartbeat on to the controller's own watchdog, which ends the program when it stays away.

Each beat of the program that uses the arm becomes one kick; there is no clock of the driver in between. So whatever
dies or stands still, that program, this process or the network between, the kicks end with it, and the controller
stops its program and the arm without anybody's help.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Generator

from drivers.interfaces import RobotSample
from drivers.ur import vendor as library
from drivers.ur.latch import Latch
from drivers.ur.link import VENDOR_ERRORS
from drivers.ur.stream import driven

LATE = 0.8  # of the watchdog's time: a longer gap between two kicks explains that it ended the program
LAPSE_S = 2.0  # longest gap that counts as a busy machine, where the arm stood
NEWS_S = 1.0  # after a gap, for what the controller did meanwhile to arrive here

_LOG = logging.getLogger(__name__)


class Watchdog:
    """Kicks the watchdog of the control script, in a thread, once for each beat.

    `newest` gives the newest sample of the arm, None where the stream is dead.
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
        self._gap_s = 0.0  # the newest one that was too long, and when it ended
        self._moving = False
        self._left_alone = self._lapsed = False
        threading.Thread(target=self._run, name="ur watchdog", daemon=True).start()

    def beat(self, sent_monotonic_s: float) -> None:
        """A sign of life of the program that uses the arm, sent then."""
        self._beat_s = sent_monotonic_s
        self._beaten.set()

    @contextlib.contextmanager
    def commanding(self) -> Generator[None]:
        """Give the control interface commands inside: a kick between a command and its answer loses the answer.

        A command is a kick as well, since it writes the same register.
        """
        with self._commands:
            yield
            self._note_kick()

    def guard(self, control: library.Control) -> None:
        """Watch the control script that runs now, unless it is watched already. Raises the vendor's errors."""
        with self._commands:
            if self._control is not None:
                return
            if not control.setWatchdog(1.0 / self._watchdog_s):
                raise RuntimeError("the control script did not take its watchdog")
            self._kicked_s, self._gap_s = time.monotonic(), 0.0
            self._control = control
            self._lapsed = False

    def release(self) -> None:
        """The script is about to be ended on purpose."""
        with self._commands:
            self._control = None
            self._moving = False

    def excuse(self) -> None:
        """A command has just failed: a script that ended with it died of it, unless its watchdog was late."""
        with self._commands:
            control = self._control
            if control is None or control.isProgramRunning():
                return
            if self._unkicked_s() > LATE * self._watchdog_s:
                self.look()
            self.release()

    def begin(self) -> None:
        """A motion is about to begin."""
        self.attend()
        self._moving = True

    def arrive(self) -> None:
        """The motion has ended as it should."""
        self._moving = False

    @property
    def moving(self) -> bool:
        """Whether a motion was begun whose end nobody has seen."""
        return self._moving

    def attend(self) -> None:
        """Somebody has just looked at the arm: the main loop of the program that uses it is alive too."""
        self._attended_s = time.monotonic()

    def look(self) -> None:
        """Find out whether the script that is guarded has ended, and why. Raises the vendor's errors."""
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
        """Whether the script has ended, while the arm stood, because this machine was busy for a moment.

        Raises the vendor's errors.
        """
        with self._commands:
            self.look()
            return self._lapsed

    def _run(self) -> None:
        while True:
            self._beaten.wait()
            self._beaten.clear()
            # Somebody who gives a command kicks by that; the next beat comes soon.
            if self._commands.acquire(timeout=self._watchdog_s / 4):
                try:
                    self._kick()
                except VENDOR_ERRORS as error:
                    _LOG.warning("kicking the watchdog failed: %s", error)
                finally:
                    self._commands.release()

    def _kick(self) -> None:
        control, sample, now_s = self._control, self._newest(), time.monotonic()
        # On a dead link the vendor's calls wait for ever; beats that waited in a queue are no signs of life.
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
        """How long there was no kick; also before the newest one, when its effect may not be known here yet."""
        now_s = time.monotonic()
        return max(now_s - self._kicked_s, self._gap_s if now_s - self._gap_end_s < NEWS_S else 0.0)
