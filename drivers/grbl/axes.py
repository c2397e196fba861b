"""Geometry of a few axes that carry specimen or camera: the pose at some values, and the values for a pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from drivers.grbl import GrblAxis
from service.core.geometry import Array, Transform, inverse, rotation_angle_rad, transform
from service.core.units import metres

_GRID = 12  # starts of the search on each axis that turns
_REFINED = 3  # of the best starts


@dataclass(frozen=True, slots=True)
class Axes:
    """The axes of a machine, in the order of its values: radians for a turn, metres for a slide.

    The room is the base frame while all axes stand at 0. Each axis is a twist in the room, so that the pose is a
    product of exponentials: T_base_flange = T_room_base⁻¹ T_room_flange (Lynch and Park, Modern Robotics, ch. 4).
    """

    axes: tuple[GrblAxis, ...]
    T_base_flange_zero: Transform

    def from_machine(self, coordinates: Sequence[float]) -> Array:
        """Values (N,) in radians and metres of machine coordinates in degrees and millimetres."""
        return np.array(coordinates, dtype=np.float64) * self._scale

    def to_machine(self, values: Array) -> Array:
        """Machine coordinates (N,) in degrees and millimetres of values in radians and metres."""
        return np.asarray(values, dtype=np.float64) / self._scale

    @property
    def _scale(self) -> Array:
        return np.array([np.radians(1.0) if axis.turns else metres(1.0) for axis in self.axes])

    @property
    def limits(self) -> tuple[Array, Array]:
        """Lowest and highest values (N,)."""
        low, high = ([getattr(axis, end) for axis in self.axes] for end in ("lowest", "highest"))
        return self.from_machine(low), self.from_machine(high)

    def T_base_flange(self, values: Array) -> Transform:
        """The pose (4, 4) of the camera's mount at values (N,)."""
        carried = {"specimen": np.eye(4), "camera": np.eye(4)}
        for axis, value in zip(self.axes, values, strict=True):
            carried[axis.carries] = carried[axis.carries] @ _motion_of(axis, float(value))
        return inverse(carried["specimen"]) @ carried["camera"] @ self.T_base_flange_zero

    def nearest(self, T_base_flange: Transform, near: Array) -> tuple[Array, float, float]:
        """Values (N,) at which the pose comes closest to the wanted one, with the distance (m) and angle (rad) left.

        Of values that differ by whole turns, those closest to `near` (N,).
        """
        from scipy.optimize import least_squares  # noqa: PLC0415 - half a second, which most commands do without

        low, high = self.limits

        def apart(values: Array) -> Array:
            gap = inverse(T_base_flange) @ self.T_base_flange(values)
            return np.concatenate([gap[:3, 3], (gap[:3, :3] - np.eye(3)).ravel()])

        grid = product(
            *(
                np.linspace(lo, hi, _GRID) if axis.turns else [(lo + hi) / 2]
                for axis, lo, hi in zip(self.axes, low, high, strict=True)
            )
        )
        starts = [np.clip(near, low, high), *(np.array(start) for start in grid)]
        starts.sort(key=lambda values: float(np.sum(apart(values) ** 2)))
        # A start on a bound is refused by the solver.
        inside = [np.clip(start, low + 1e-9, high - 1e-9) for start in starts[:_REFINED]]
        found = [
            least_squares(apart, start, bounds=(low, high), xtol=1e-12, ftol=1e-12, gtol=1e-12) for start in inside
        ]
        best = self._unwound(min(found, key=lambda one: one.cost).x, near)
        gap = inverse(T_base_flange) @ self.T_base_flange(best)
        return best, float(np.linalg.norm(gap[:3, 3])), rotation_angle_rad(gap)

    def _unwound(self, values: Array, near: Array) -> Array:
        """Values of the axes with whole revolutions added to each turn, within its range, to be closest to `near`."""
        low, high = self.limits
        out = values.copy()
        for i, axis in enumerate(self.axes):
            if axis.turns:
                alike = values[i] + 2 * np.pi * np.arange(-20, 21)
                alike = alike[(alike >= low[i] - 1e-9) & (alike <= high[i] + 1e-9)]
                out[i] = alike[np.argmin(np.abs(alike - near[i]))]
        return out


def _motion_of(axis: GrblAxis, value: float) -> Transform:
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - as above

    direction = np.array(axis.direction) / np.linalg.norm(axis.direction)
    if not axis.turns:
        return transform(np.eye(3), direction * value)
    R = Rotation.from_rotvec(direction * value).as_matrix()
    through = np.array(axis.through_m)
    return transform(R, through - R @ through)
