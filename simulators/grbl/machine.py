"""The simulated machine: settings, axes that accelerate and brake, limit switches, and homing."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from simulators.geometry import Array

AXES = 3
PLANNER_BLOCKS = 15
FACTORY: Mapping[int, float] = {
    0: 10, 1: 255, 2: 0, 3: 0, 4: 0, 5: 0, 6: 0, 10: 1, 11: 0.01, 12: 0.002, 13: 0,
    20: 1, 21: 1, 22: 1, 23: 0, 24: 120, 25: 3600, 26: 250, 27: 1, 30: 1000, 31: 0, 32: 0,
    100: 80, 101: 200, 102: 200, 110: 3600, 111: 3000, 112: 3000, 120: 60, 121: 300, 122: 300,
    130: 720, 131: 300, 132: 100,
}  # fmt: skip
_POWER_UP = (-137.0, -42.0, -13.0)  # where it stands, from the switches at the positive ends


@dataclass(frozen=True, slots=True)
class Block:
    """A straight piece of motion to a target (3,) at a feed in units a minute."""

    target: Array
    feed_per_min: float


class Machine:
    """Three axes, in degrees or millimetres from their switches; `origin` is what the controller takes for 0."""

    def __init__(self, settings: Mapping[int, float], speed_up: float) -> None:
        self.settings = dict(FACTORY) | dict(settings)
        self._speed_up = speed_up
        # Within the travel of a small machine. Plain numbers: NumPy costs ten times as much on three of them.
        self._true = [max(place, -0.5 * abs(travel)) for place, travel in zip(_POWER_UP, self._of(130), strict=True)]
        self._origin = [*self._true]  # without homing, 0 is where it stood at power-up
        self.work_offset = np.array([-12.5, 7.0, 0.0])  # of G54, as somebody left it
        self.blocks: deque[Block] = deque()
        self._speed = 0.0  # along the path, units a second
        self._holding = False
        self._homing: deque[list[float]] = deque()  # true positions still to visit

    def _of(self, number: int) -> list[float]:
        """The settings `number`, `number` + 1 … of the axes (3,)."""
        return [float(self.settings[number + i]) for i in range(AXES)]

    def per_axis(self, number: int) -> Array:
        """The settings `number`, `number` + 1 … of the axes (3,)."""
        return np.array(self._of(number))

    @property
    def true_position(self) -> Array:
        """Coordinates (3,) from the switches."""
        return np.array(self._true)

    @property
    def position(self) -> Array:
        """Machine coordinates (3,) as the controller counts them, in whole steps."""
        steps = self.per_axis(100)
        return np.round((np.array(self._true) - np.array(self._origin)) * steps) / steps

    @property
    def travelling(self) -> bool:
        """Return whether an axis turns."""
        return self._speed > 0 or bool(self.blocks) or bool(self._homing)

    @property
    def feed_per_min(self) -> float:
        """The speed along the path."""
        return 60.0 * self._speed

    @property
    def at_a_switch(self) -> bool:
        """Return whether an axis stands on a limit switch, at either end of its travel."""
        ends = zip(self._true, self._of(130), strict=True)
        return any(place > 1e-6 or place < -travel - 1.0 for place, travel in ends)

    @property
    def end(self) -> Array:
        """Return where the last planned block ends (3,), in machine coordinates."""
        return self.blocks[-1].target if self.blocks else self.position

    def hold(self) -> None:
        """Brake to a standstill and stay there."""
        self._holding = True

    def release(self) -> None:
        """End the hold."""
        self._holding = False

    def halt(self) -> None:
        """Stop all at once and forget what was planned."""
        self.blocks.clear()
        self._homing.clear()
        self._speed, self._holding = 0.0, False

    def begin_homing(self) -> None:
        """Travel to the switches at the positive ends, Z first, and pull off from them."""
        place = [*self._true]
        for axes in ([2], [0, 1]):
            for goal in (0.0, -float(self.settings[27])):
                place = [goal if axis in axes else before for axis, before in enumerate(place)]
                self._homing.append(place)

    def advance(self, elapsed_s: float) -> bool:
        """Let time pass; returns whether homing has just ended."""
        elapsed_s *= self._speed_up
        if self._homing:
            return self._home(elapsed_s)
        while elapsed_s > 1e-9 and (self.blocks or self._speed > 0):
            step_s = min(elapsed_s, 0.002)
            self._travel(step_s)
            elapsed_s -= step_s
        return False

    def _home(self, elapsed_s: float) -> bool:
        way = _between(self._true, self._homing[0])
        length = math.hypot(*way)
        reach = self.settings[25] / 60.0 * elapsed_s
        if reach < length:
            self._move(way, reach / length)
            return False
        self._true = self._homing.popleft()
        if not self._homing:
            self._origin = [0.0] * AXES
        return not self._homing

    def _move(self, way: list[float], share: float) -> None:
        self._true = [place + share * part for place, part in zip(self._true, way, strict=True)]

    def _travel(self, step_s: float) -> None:
        """One short step along the planned path, which is taken to be straight within the planner's look-ahead."""
        if not self.blocks:
            self._speed = 0.0
            return
        block = self.blocks[0]
        goal = [target + origin for target, origin in zip(block.target.tolist(), self._origin, strict=True)]
        way = _between(self._true, goal)
        length = math.hypot(*way)
        if length < 1e-9:
            self.blocks.popleft()
            return
        shares = [(axis, share) for axis, part in enumerate(way) if (share := abs(part) / length) > 0]
        acceleration = min(self.settings[120 + axis] / share for axis, share in shares)
        fastest = min(block.feed_per_min, *(self.settings[110 + axis] / share for axis, share in shares)) / 60.0
        soonest = math.sqrt(max(0.0, 2 * acceleration * self._length_ahead(way, length)))  # to stand at its end
        target = 0.0 if self._holding else min(fastest, soonest)
        change = acceleration * step_s
        self._speed = float(min(max(target, self._speed - 1.1 * change), self._speed + change))
        if self._holding and self._speed <= 0:
            return
        going = max(self._speed, 1e-3) * step_s
        if going >= length:
            self._true = goal
            self.blocks.popleft()
            if not self.blocks:
                self._speed = 0.0
        else:
            self._move(way, going / length)

    def _length_ahead(self, way: list[float], length: float) -> float:
        """Length of the path up to its end, or to the first corner."""
        total, before = length, self.blocks[0].target.tolist()
        for block in list(self.blocks)[1:]:
            after = block.target.tolist()
            step = _between(before, after)
            long = math.hypot(*step)
            if sum(a * b for a, b in zip(step, way, strict=True)) < 0.999 * long * length:
                break
            total += long
            before = after
        return total


def _between(begin: list[float], end: list[float]) -> list[float]:
    """Return the way (3,) from one place to another."""
    return [there - here for here, there in zip(begin, end, strict=True)]
