"""Rigid transforms as (4, 4) float64, named T_a_b: p_a = T_a_b @ p_b."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Transform = Array  # (4, 4), last row 0 0 0 1


def transform(rotation: Array | Rotation, translation_m: Array) -> Transform:
    """Build T_a_b from the rotation of b's axes in a and the position of b's origin in a (3,)."""
    T = np.eye(4)
    T[:3, :3] = rotation if isinstance(rotation, np.ndarray) else rotation.as_matrix()
    T[:3, 3] = translation_m
    return T


def _rotations() -> type[Rotation]:
    """Import SciPy's rotations on first use: it takes half a second, which most commands do without."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415

    return Rotation


def inverse(T_a_b: Transform) -> Transform:
    """Return T_b_a (4, 4), from the transposed rotation, so that it stays exactly rigid."""
    R = T_a_b[:3, :3]
    return transform(R.T, -R.T @ T_a_b[:3, 3])


def apply(T_a_b: Transform, points_b: Array) -> Array:
    """Map points (..., 3) from frame b to frame a."""
    return points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def from_rotation_vector(pose: Array) -> Transform:
    """Return T_a_b from a Universal Robots pose: (6,) x, y, z in metres and rotation vector in radians."""
    x, y, z, *turn = pose.tolist()
    (a, b, c), (d, e, f), (g, h, i) = _rotation(*turn)
    return np.array([[a, b, c, x], [d, e, f, y], [g, h, i, z], [0.0, 0.0, 0.0, 1.0]])


def _rotation(x: float, y: float, z: float) -> tuple[tuple[float, float, float], ...]:
    """Return the matrix rows of a rotation vector, by way of its unit quaternion; not a number unless it is finite.

    In plain floats: SciPy's conversion takes ten times as long for a single vector, and an arm sends 125 a second.
    """
    angle = math.sqrt(x * x + y * y + z * z)
    if not math.isfinite(angle):
        none = (math.nan, math.nan, math.nan)
        return (none, none, none)
    if angle <= 1e-3:  # by its series: the quotient is 0 / 0 where there is no rotation
        square = angle * angle
        share = 0.5 - square / 48 + square * square / 3840
    else:
        share = math.sin(angle / 2) / angle
    x, y, z, w = share * x, share * y, share * z, math.cos(angle / 2)
    xx, yy, zz, ww = x * x, y * y, z * z, w * w
    xy, xz, yz, xw, yw, zw = x * y, x * z, y * z, x * w, y * w, z * w
    return (
        (xx - yy - zz + ww, 2 * (xy - zw), 2 * (xz + yw)),
        (2 * (xy + zw), -xx + yy - zz + ww, 2 * (yz - xw)),
        (2 * (xz - yw), 2 * (yz + xw), -xx - yy + zz + ww),
    )


def to_rotation_vector(T_a_b: Transform) -> Array:
    """Return the (6,) pose x, y, z in metres and rotation vector in radians of T_a_b."""
    return np.concatenate([T_a_b[:3, 3], _rotations().from_matrix(T_a_b[:3, :3]).as_rotvec()])


def from_quaternion(translation_m: Array, quaternion_xyzw: Array) -> Transform:
    """Return T_a_b from (3,) position and (4,) scalar-last quaternion."""
    return transform(_rotations().from_quat(quaternion_xyzw), translation_m)


def skew(v: Array) -> Array:
    """Return (..., 3, 3) cross-product matrices of vectors (..., 3)."""
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def increment(T: Transform, d: Array, w: Array) -> Transform:
    """Return exp(w) R, t + d: the project's pose perturbation, in the axes of the outer frame."""
    return transform(_rotations().from_rotvec(w).as_matrix() @ T[:3, :3], T[:3, 3] + d)


def place_jacobian(turned: Array) -> Array:
    """Return (n, 3, 6) derivative of points by (d, w) of a pose; `turned` (n, 3): points rotated, not translated."""
    return np.concatenate([np.broadcast_to(np.eye(3), (len(turned), 3, 3)), -skew(turned)], axis=2)


def look_at(eye: Array, target: Array, up: Array) -> Transform:
    """Return T_world_camera (x right, y down, z forward) at `eye`, looking at `target`, image top towards `up`."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    return transform(np.stack([x, np.cross(z, x), z], axis=1), eye)


def rotation_about_z(angle_rad: float) -> Transform:
    """Return the rotation about the z axis, which is a camera's optical axis."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return transform(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))


def rotation_angle_rad(T: Transform) -> float:
    """Return the angle of the rotation part in radians, 0 to pi."""
    return float(_rotations().from_matrix(T[:3, :3]).magnitude())


def align_points(a: Array, b: Array, *, with_scale: bool = False) -> tuple[Transform, float]:
    """Least-squares T_a_b and scale s with a ≈ R (s b) + t, for corresponding points (N, 3).

    Source: Umeyama, "Least-squares estimation of transformation parameters between two point patterns",
    PAMI 13(4), 1991.
    """
    ca, cb = a.mean(axis=0), b.mean(axis=0)
    U, S, Vt = np.linalg.svd((a - ca).T @ (b - cb))
    D = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ D @ Vt
    s = float(np.trace(np.diag(S) @ D) / np.sum((b - cb) ** 2)) if with_scale else 1.0
    return transform(R, ca - s * R @ cb), s
