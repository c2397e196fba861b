"""Whether an arm may move as fast as a protocol says: its own limits, and how soon it stands if the program dies."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from drivers.interfaces import Abandoned
from service.core.arms.model import ArmModel
from service.core.protocol.models import Motion

_ROUNDING_S = 1e-9


def motion_problems(
    motion: Motion, arms: Sequence[ArmModel], abandoned: Abandoned | None
) -> Iterator[tuple[str, str]]:
    """Yield the fields of a protocol's motion that are too large, with a text that says for what.

    Args:
        motion: the protocol's section; its speed and acceleration are those of the fastest joint, whichever that is.
        arms: those that may be meant, at least one; a motion is too fast if it is so for each of them.
        abandoned: when the controller notices that the program died, and how soon the arm must stand; None if the
            device sees to that by itself.
    """
    arm = max(arms, key=lambda one: float(one.speeds_rad_s.min()))
    among = f"a {arm.name}" if len(arms) == 1 else f"a {arm.name}, the fastest arm that is known,"
    joint = int(np.argmin(arm.speeds_rad_s))
    most_rad_s = float(arm.speeds_rad_s[joint])
    if motion.speed_rad_s > most_rad_s:
        yield "speed_rad_s", f"joint {joint + 1} of {among} turns by {most_rad_s:.2f} rad/s at most"
    most_rad_s2 = max(one.acceleration_rad_s2 for one in arms)
    if motion.acceleration_rad_s2 > most_rad_s2:
        yield "acceleration_rad_s2", f"the controller of {among} takes {most_rad_s2:g} rad/s² at most"
    if abandoned is None:
        return
    braking_rad_s2 = max(one.braking_rad_s2 for one in arms)
    rests_after_s = abandoned.noticed_after_s + motion.speed_rad_s / braking_rad_s2
    if rests_after_s > abandoned.rest_within_s + _ROUNDING_S:
        slow_enough_rad_s = max(0.0, abandoned.rest_within_s - abandoned.noticed_after_s) * braking_rad_s2
        yield (
            "speed_rad_s",
            f"if the program dies, the arm stands after {rests_after_s:.2f} s ({abandoned.noticed_after_s:g} s until "
            f"that is noticed, then braking with {braking_rad_s2:g} rad/s²), and rest_within_s of the rig file "
            f"allows {abandoned.rest_within_s:g} s: move with {slow_enough_rad_s:.2f} rad/s at most",
        )
