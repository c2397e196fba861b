"""Rigid transforms for the simulators, as (4, 4) float64 named T_a_b: p_a = T_a_b @ p_b."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Array32 = NDArray[np.floating]  # single precision where it matters; numpy stubs lose it in mixed arithmetic
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Bytes = NDArray[np.uint8]
Json = dict[str, Any]


def transform(rotation: Array, translation_m: Array) -> Array:
    """Build T_a_b from the rotation (3, 3) of b's axes in a, and the position (3,) of b's origin in a."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation_m
    return T


def from_euler(xyz_rad: Array, translation_m: Array) -> Array:
    """Build T_a_b from rotations about the fixed x, y and z axes, in this order, and a position (3,)."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - 0.2 s, which simulators without a scene do without

    return transform(Rotation.from_euler("xyz", xyz_rad).as_matrix(), translation_m)


def inverse(T_a_b: Array) -> Array:
    """Invert a rigid transform; the result is exactly rigid."""
    R = T_a_b[:3, :3]
    return transform(R.T, -R.T @ T_a_b[:3, 3])


def apply(T_a_b: Array, points_b: Array) -> Array:
    """Map points (..., 3) from frame b to frame a."""
    return points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def look_at(eye: Array, target: Array, up: Array) -> Array:
    """Build T_world_camera (x right, y down, z forward) at `eye`, looking at `target`, image top towards `up`."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    return transform(np.stack([x, np.cross(z, x), z], axis=1), eye)


def smoothstep(low: float, high: float, x: Array) -> Array:
    """Smooth step: 0 below `low`, 1 above `high`, cubic between (falling if low > high)."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)
