"""Confirmation by foot pedal: one press if nothing moves, two presses within seconds if the robot will move.

What is read from the box may be wrong or late, and a robot moves by it. So a press is a count that is one more than
before, and nothing else; a press that lets the robot move is timed by the box, and its time must fit what the host
has read before; and as soon as a reading is late the pedal is disarmed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from drivers.errors import DeviceError
from drivers.interfaces import PedalReading
from service.core.run.decide import AskOperator

_RETRY_S = 30.0
# If the robot will move, one press arms the pedal and a second one, this many seconds after it, confirms; on a screen
# the button is held instead. A press that comes sooner may be a bounce of the contact or a slip of the foot.
SECOND_PRESS_S = (0.5, 6.0)
LATE_S = 0.5  # between two readings, five times the usual: presses that lie between cannot be distinguished
CLOCKS_DIFFER_S = 0.25  # by how much the box's clock and the host's may differ between two readings


@dataclass(frozen=True, slots=True)
class _Looked:
    """A reading, and when it was made by the host's clock."""

    reading: PedalReading
    at_s: float


@dataclass
class Pedal:
    """Turns the light box's count of presses into confirmations of the open question.

    `read` returns the count since the box was switched on, None without a box, and may raise DeviceError. A press
    confirms only the question that was open at the time: the first call for a question only reads the count.
    """

    read: Callable[[], PedalReading | None]
    monotonic_s: Callable[[], float]
    tell: Callable[[str], None]
    _question: AskOperator | None = field(init=False, default=None)
    _last: _Looked | None = field(init=False, default=None)  # None until the first call for the open question
    _armed_by_s: float | None = field(init=False, default=None)  # the press that armed the pedal, by the box's clock
    _armed_at_s: float = field(init=False, default=0.0)  # when that was read
    _silent_until_s: float = field(init=False, default=0.0)
    _told: str = field(init=False, default="")  # why the pedal does not work, reported once until it works again

    @property
    def armed(self) -> bool:
        """True if a second press would let the robot move."""
        return self._armed_by_s is not None

    def confirms(self, question: AskOperator, *, moves_robot: bool) -> bool:
        """Return whether the pedal has confirmed the question since the last call; call it while it is open."""
        if question != self._question:
            self._question, self._last, self._armed_by_s = question, None, None
        before = self._last
        self._last = now = self._looked()
        if self.armed and (now is None or now.at_s - self._armed_at_s > SECOND_PRESS_S[1]):
            self._armed_by_s = None
        if now is None or before is None:
            return False
        if now.reading.presses == before.reading.presses:
            self._in_time(before, now)
            return False
        if now.reading.presses != before.reading.presses + 1:
            fewer = now.reading.presses < before.reading.presses  # a box that was switched off counts from zero
            self._disarm(
                "the light box was switched off and on" if fewer else "the pedal counts more than one press at once"
            )
            return False
        if "confirm" not in question.options:
            return False
        return self._lets_move(before, now) if moves_robot else True

    def _lets_move(self, before: _Looked, now: _Looked) -> bool:
        """Return whether this press is the second of two. `now` counts one press more than `before`."""
        pressed_s = now.reading.pressed_s
        if pressed_s is None or now.reading.now_s is None:
            self._tell_once(
                "the pedal cannot let the robot move: a light box before firmware 1.4 does not time its presses. "
                "Confirm on the screen"
            )
            return False
        prompt = self._in_time(before, now)  # otherwise this press is a first one at most
        since_last_s = now.at_s - before.at_s + CLOCKS_DIFFER_S
        if not 0.0 <= now.reading.now_s - pressed_s <= since_last_s:
            self._disarm("the time of the press does not fit")
            return False
        earliest_s, latest_s = SECOND_PRESS_S
        if prompt and self._armed_by_s is not None and earliest_s <= pressed_s - self._armed_by_s <= latest_s:
            self._armed_by_s = None
            return True
        self._armed_by_s, self._armed_at_s = pressed_s, now.at_s
        self.tell(f"pedal: press again within {latest_s:.0f} s to let the robot move")
        return False

    def _in_time(self, before: _Looked, now: _Looked) -> bool:
        """Return whether a reading came in time, by both clocks; otherwise disarm the pedal."""
        by_host_s = now.at_s - before.at_s
        if by_host_s > LATE_S:
            self._disarm(f"the light box answered {by_host_s:.1f} s after the reading before")
            return False
        then_s, now_s = before.reading.now_s, now.reading.now_s
        if then_s is not None and now_s is not None and abs(now_s - then_s - by_host_s) > CLOCKS_DIFFER_S:
            self._disarm("the light box's clock jumped")
            return False
        return True

    def _disarm(self, why: str) -> None:
        if self.armed:
            self.tell(f"pedal: {why}; press twice again to let the robot move")
        self._armed_by_s = None

    def _looked(self) -> _Looked | None:
        """Read the count; None without a box, or while it does not work."""
        if self.monotonic_s() < self._silent_until_s:
            return None
        try:
            reading = self.read()
        except DeviceError as error:
            self._silent_until_s = self.monotonic_s() + _RETRY_S
            self._tell_once(f"the foot pedal does not work: {error}")
            return None
        if reading is None:
            return None
        if self._told.startswith("the foot pedal does not work"):
            self._told = ""
        return _Looked(reading, self.monotonic_s())

    def _tell_once(self, words: str) -> None:
        if words != self._told:
            self._told = words
            self.tell(words)
