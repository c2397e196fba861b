"""Observed cones of spheres as arrays, and their residuals against spheres at predicted places."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.compute.markers.cones import Cone
from service.core.geometry import Array


@dataclass(frozen=True, slots=True)
class ObservedCones:
    """O cones of spheres in the camera frame.

    Attributes:
        axes: (O, 3) unit vectors to the spheres' centres, which are not the ellipses' centres.
        half_angles: (O,) radians.
        directions: (O, 3, K) unit vectors, in columns, along which a tilt of the axis is measured.
    """

    axes: Array
    half_angles: Array
    directions: Array

    @classmethod
    def of(cls, cones: Iterable[Cone]) -> ObservedCones:
        """With tilts along the first two columns of each cone's `frame()`, as in SphereOutline.cone_covariance."""
        found = list(cones)
        return cls(
            np.array([c.axis for c in found], dtype=np.float64).reshape(-1, 3),
            np.array([c.half_angle_rad for c in found], dtype=np.float64),
            np.array([c.frame()[:, :2] for c in found], dtype=np.float64).reshape(-1, 3, 2),
        )

    @classmethod
    def with_chords(cls, axes: Array, half_angles: Array) -> ObservedCones:
        """Convert tilts to the camera's three axes, where they are differences of unit vectors."""
        return cls(axes, half_angles, np.broadcast_to(np.eye(3), (len(axes), 3, 3)))

    def __len__(self) -> int:
        """Number of cones."""
        return len(self.axes)

    def take(self, which: NDArray[np.int64]) -> ObservedCones:
        """The cones of these indices, which may repeat."""
        return ObservedCones(self.axes[which], self.half_angles[which], self.directions[which])

    def residuals(self, centres_camera_m: Array, radius_m: float) -> tuple[Array, Array]:
        """Residuals (O, K + 1) in radians against spheres, and their derivative (O, K + 1, 3) by the centres.

        Args:
            centres_camera_m: (O, 3) predicted centres in the camera frame.
            radius_m: radius of the spheres.

        A sphere at c appears as the cone with the axis u = c / |c| and sin(a) = r / |c|. Its residual is the tilt of
        u along the directions, and a minus the observed half angle. With two directions across the axis, these three
        numbers hold all the information of an outline and are nearly linear in c.
        """
        distance = np.linalg.norm(centres_camera_m, axis=1)
        u = centres_camera_m / distance[:, None]
        half = np.arcsin(np.clip(radius_m / distance, 0.0, 0.999))
        across = np.einsum("oik,oi->ok", self.directions, u - self.axes)
        r = np.column_stack([across, half - self.half_angles])
        tangent = np.eye(3) - u[:, :, None] * u[:, None, :]
        tilt = np.einsum("oik,oij->okj", self.directions, tangent) / distance[:, None, None]
        shrink = -np.tan(half)[:, None] * u / distance[:, None]
        return r, np.concatenate([tilt, shrink[:, None, :]], axis=1)
