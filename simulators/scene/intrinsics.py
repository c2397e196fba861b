"""The simulated lens: pinhole with two radial and two tangential distortion terms (OpenCV's conventions)."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from simulators.geometry import Array

FULL_WIDTH, FULL_HEIGHT = 9504, 6336


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """Camera intrinsics in pixels of a width × height image; pixel centres lie at integer coordinates."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float
    p1: float
    p2: float

    def to_json(self) -> dict[str, float | int]:
        """Return the fields by name, as in camera.json."""
        return dataclasses.asdict(self)

    def scaled(self, width: int) -> Intrinsics:
        """Return the same lens at another image width; the height keeps the sensor's 3:2."""
        height = round(width * FULL_HEIGHT / FULL_WIDTH)
        sx, sy = width / self.width, height / self.height
        return dataclasses.replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
        )

    def project(self, points_camera: Array) -> Array:
        """Project points (..., 3) in the camera frame to pixels (..., 2)."""
        x, y = (points_camera[..., k] / points_camera[..., 2] for k in (0, 1))
        xd, yd = self._distort(x, y)
        return np.stack([self.fx * xd + self.cx, self.fy * yd + self.cy], axis=-1)

    def rays(self, pixels: Array) -> Array:
        """Return ray directions (..., 3) with z = 1 in the camera frame for pixels (..., 2), accurate to 1e-12."""
        xd = (pixels[..., 0] - self.cx) / self.fx
        yd = (pixels[..., 1] - self.cy) / self.fy
        x, y = xd, yd
        for _ in range(9):  # each iteration gains about 1.3 digits for |k1| r² < 0.05
            xe, ye = self._distort(x, y)
            x, y = x + (xd - xe), y + (yd - ye)
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def _distort(self, x: Array, y: Array) -> tuple[Array, Array]:
        r2 = x * x + y * y
        radial = 1.0 + r2 * (self.k1 + r2 * self.k2)
        xd = x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x)
        yd = y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y
        return xd, yd
