"""The motion latch: after opening and after every stop the arm stays locked until a person permits motion."""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass

from drivers.errors import DeviceError, LeaveNeededError, SafetyStopError, ToolChangedError
from drivers.interfaces import SafetyState

_LOG = logging.getLogger(__name__)
_LOOK = "Look for the cause, and whether anybody is in reach; the arm moves on after a person has confirmed"
_ASK = "Ask who changed it at the pendant; after a person has confirmed, the tool of the rig file is set again"


@dataclass(frozen=True, slots=True)
class _Held:
    """Why the arm is held, and when that was last seen (host time.monotonic())."""

    what: str
    last_s: float


class Latch:
    """Holds the arm from the moment it is opened, and again after every stop; thread-safe.

    It follows the controller's stream, so it also latches a stop that came and went between two calls.
    """

    def __init__(self, where: str) -> None:
        self._where = where
        self._lock = threading.Lock()
        self._let_by = ""
        self._stop: _Held | None = None  # of the safety system
        self._ended: _Held | None = None  # the controller's program ended without this driver asking for it
        self._changed: _Held | None = None  # the tool, by somebody else

    def close(self) -> None:
        """Revoke the permission; opening the arm again needs a new one, and reads the tool anew."""
        with self._lock:
            self._let_by, self._changed = "", None

    def see(self, safety: SafetyState, at_s: float, what: str = "") -> None:
        """Latch the arm if this sample of the stream shows a stop.

        `at_s` is its host time.monotonic(), `what` the controller's own name of the stop, if it has one.
        """
        if safety.may_move:
            return
        name = what or _name(safety)
        with self._lock:
            if self._stop is None:
                _LOG.warning("%s: %s; nothing moves until a person confirms", self._where, name)
            self._stop = _Held(name, at_s)

    def end(self, what: str) -> None:
        """Latch the arm because the controller's program ended unexpectedly; `what` is a sentence that says so."""
        with self._lock:
            _LOG.warning("%s: %s; nothing moves until a person confirms", self._where, what)
            self._ended = _Held(what, time.monotonic())

    def change(self, what: str) -> None:
        """Latch the arm because somebody changed its tool; `what` is a sentence that says so."""
        with self._lock:
            if self._changed is None:
                _LOG.warning("%s: %s; nothing moves until a person confirms", self._where, what)
            self._changed = _Held(what if self._changed is None else self._changed.what, time.monotonic())

    def let_move(self, confirmed_by: str, not_before_monotonic_s: float) -> None:
        """Permit motion and clear stops that were over at `not_before_monotonic_s` (host time.monotonic()).

        Raises SafetyStopError, LeaveNeededError or ToolChangedError for what was seen after that time.
        """
        with self._lock:
            for held in (self._stop, self._ended, self._changed):
                if held is not None and held.last_s > not_before_monotonic_s:
                    raise self._error()
            _LOG.info("%s: %s lets the arm move", self._where, confirmed_by)
            self._let_by, self._stop, self._ended, self._changed = confirmed_by, None, None, None

    @property
    def stop(self) -> DeviceError | None:
        """The stop, end of the program or change of the tool that nobody has confirmed yet; None if there is none."""
        with self._lock:
            return self._error() if self._holds else None

    @property
    def changed(self) -> DeviceError | None:
        """The change of the tool that nobody has confirmed yet; None if there is none."""
        with self._lock:
            return None if self._changed is None else self._tool_error(self._changed)

    @property
    def hold(self) -> DeviceError | None:
        """Why the arm may not move: `stop`, or that nobody has permitted motion yet; None if it may."""
        with self._lock:
            return None if self._let_by and not self._holds else self._error()

    @property
    def _holds(self) -> bool:
        return any(held is not None for held in (self._stop, self._ended, self._changed))

    def _error(self) -> DeviceError:
        if self._stop is not None:
            ago_s = time.monotonic() - self._stop.last_s
            what = f"the arm was in {self._stop.what} {ago_s:.0f} s ago, and nobody has confirmed since"
            return SafetyStopError(what, where=self._where, remedy=_LOOK)
        if self._ended is not None:
            what = f"{self._ended.what}, and nobody has confirmed since"
            return LeaveNeededError(what, where=self._where, remedy=_LOOK)
        if self._changed is not None:
            return self._tool_error(self._changed)
        return LeaveNeededError("nobody has let the arm move since it was connected", where=self._where, remedy=_LOOK)

    def _tool_error(self, changed: _Held) -> ToolChangedError:
        what = f"{changed.what}, and nobody has confirmed since"
        return ToolChangedError(what, where=self._where, remedy=_ASK)


def _name(safety: SafetyState) -> str:
    return safety.value.replace("_", " ")
