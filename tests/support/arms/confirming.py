"""A person confirms a motion, and once more where this machine stood still for longer than a watchdog allows."""

from __future__ import annotations

import time
from collections.abc import Callable

from drivers.errors import DeviceUnavailableError, LeaveNeededError
from drivers.interfaces import RobotArm

_WITHIN_S, _PAUSE_S = 90.0, 0.1


def confirm_and(arm: RobotArm, motion: Callable[[], None]) -> None:
    """Let the arm move and call `motion`; both again as long as a lapse of this machine takes the leave away."""
    deadline_s = time.monotonic() + _WITHIN_S
    while True:
        try:
            arm.let_move("Ada", time.monotonic())
            motion()
        except (LeaveNeededError, DeviceUnavailableError) as error:
            if time.monotonic() > deadline_s:
                raise
            time.sleep(_PAUSE_S)
            if isinstance(error, DeviceUnavailableError):
                arm.open()
        else:
            return
