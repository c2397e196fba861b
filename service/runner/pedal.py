"""Confirmation by foot pedal: one press if nothing moves, two presses within seconds if the robot will move."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from drivers.errors import DeviceError
from service.core.run.decide import AskOperator

_RETRY_S = 30.0
# If the robot will move, one press arms the pedal and a second one, this many seconds after it, confirms; on a screen
# the button is held instead. A press that comes sooner may be a bounce of the contact or a slip of the foot.
SECOND_PRESS_S = (0.5, 6.0)


@dataclass
class Pedal:
    """Turns the light box's count of presses into confirmations of the open question.

    `presses` returns the count since the box was switched on, 0 without a box, and may raise DeviceError. A press
    confirms only the question that was open at the time: the first call for a question only reads the count.
    """

    presses: Callable[[], int]
    monotonic_s: Callable[[], float]
    tell: Callable[[str], None]
    _question: AskOperator | None = field(init=False, default=None)
    _count: int | None = field(init=False, default=None)  # None until the first call for the open question
    _armed_s: float | None = field(init=False, default=None)  # time of the press that armed the pedal
    _silent_until_s: float = field(init=False, default=0.0)
    _told: str = field(init=False, default="")  # why the box does not answer, told once until it answers again

    @property
    def armed(self) -> bool:
        """Whether a second press would let the robot move."""
        return self._armed_s is not None

    def confirms(self, question: AskOperator, *, moves_robot: bool) -> bool:
        """Whether the pedal has confirmed the question since the last call; call it while the question is open."""
        if question != self._question:
            self._question, self._count, self._armed_s = question, None, None
        if not self._pressed() or "confirm" not in question.options:
            return False
        return self._second_press() if moves_robot else True

    def _second_press(self) -> bool:
        earliest_s, latest_s = SECOND_PRESS_S
        now_s = self.monotonic_s()
        if self._armed_s is None or now_s - self._armed_s < earliest_s:
            self._armed_s = now_s
            self.tell(f"pedal: press again within {latest_s:.0f} s to let the robot move")
            return False
        self._armed_s = None
        return True

    def _pressed(self) -> bool:
        now_s = self.monotonic_s()
        if self._armed_s is not None and now_s - self._armed_s > SECOND_PRESS_S[1]:
            self._armed_s = None
        if now_s < self._silent_until_s:
            return False
        try:
            count = self.presses()
        except DeviceError as error:
            self._silent_until_s = self.monotonic_s() + _RETRY_S
            if str(error) != self._told:
                self._told = str(error)
                self.tell(f"the foot pedal does not work: {error}")
            return False
        self._told = ""
        if self._count is None or count < self._count:  # a light box that was switched off counts from zero
            self._count = count
        pressed, self._count = count != self._count, count
        return pressed
