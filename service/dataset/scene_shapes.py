"""Shapes of which the scene in 3D is drawn: cameras as small pyramids, and a ball."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from service.core.geometry import Array, Transform, apply
from service.core.units import metres, mm

_FRUSTUM_MM = 50.0
_ROUND, _FLAT = 10, 6  # meridians and parallels of a sphere


def frustum_lines(cameras: Sequence[Transform]) -> Array:
    """Line segments (N, 3) in mm that draw each camera as a small pyramid, separated by NaN rows."""
    w, h, z = 0.36 * _FRUSTUM_MM, 0.24 * _FRUSTUM_MM, _FRUSTUM_MM
    o, a, b, c, d = [0, 0, 0], [-w, -h, z], [w, -h, z], [w, h, z], [-w, h, z]
    path = metres(np.array([o, a, b, c, d, a, o, b, o, c, o, d], dtype=np.float64))
    gap = np.full((1, 3), np.nan)
    return np.vstack([np.vstack([mm(apply(T, path)), gap]) for T in cameras]) if cameras else gap


def unit_ball() -> tuple[Array, NDArray[np.int64]]:
    """A unit sphere: points (V, 3), triangles (F, 3)."""
    polar = np.linspace(0, np.pi, _FLAT + 1)[1:-1]
    around = np.linspace(0, 2 * np.pi, _ROUND, endpoint=False)
    rings = [[np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)] for p in polar for a in around]
    points = np.array([[0.0, 0.0, 1.0], *rings, [0.0, 0.0, -1.0]])
    last = len(points) - 1
    faces: list[list[int]] = []
    for k in range(_ROUND):
        nxt = (k + 1) % _ROUND
        faces += [[0, 1 + k, 1 + nxt], [last, last - _ROUND + nxt, last - _ROUND + k]]
        for ring in range(_FLAT - 2):
            a, b = 1 + ring * _ROUND + k, 1 + ring * _ROUND + nxt
            faces += [[a, a + _ROUND, b], [b, a + _ROUND, b + _ROUND]]
    return points, np.array(faces)
