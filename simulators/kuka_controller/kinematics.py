"""Kinematics of the LBR arms: forward from the DH table, the Jacobian, and a numeric inverse for a start posture."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

HALF = math.pi / 2


@dataclass(frozen=True, slots=True)
class Model:
    """An arm: offsets d along the joints' axes (metres), twists α, and its ratings. All link lengths a are 0."""

    name: str
    d_m: tuple[float, ...]
    alpha_rad: tuple[float, ...]
    limits_rad: tuple[float, ...]
    speeds_rad_s: tuple[float, ...]
    payload_kg: float


def _lbr(name: str) -> Model:
    return Model(
        name,
        (0.360, 0.0, 0.420, 0.0, 0.400, 0.0, 0.126),
        (-HALF, HALF, HALF, -HALF, -HALF, HALF, 0.0),
        tuple(math.radians(v) for v in (170, 120, 170, 120, 170, 120, 175)),
        tuple(math.radians(v) for v in (85, 85, 100, 75, 130, 135, 135)),
        14.0,
    )


MODELS = {name: _lbr(name) for name in ("LBR Med 14", "LBR iiwa 14")}


def frames(model: Model, q: Array) -> list[Array]:
    """Return T_base_0 … T_base_7 (4, 4) along the chain at joints q (7,) in radians; the last one is the flange."""
    chain = [np.eye(4)]
    for angle, d, alpha in zip(q, model.d_m, model.alpha_rad, strict=True):
        c, s, ca, sa = math.cos(angle), math.sin(angle), math.cos(alpha), math.sin(alpha)
        link = np.array([[c, -s * ca, s * sa, 0.0], [s, c * ca, -c * sa, 0.0], [0.0, sa, ca, d], [0, 0, 0, 1.0]])
        chain.append(chain[-1] @ link)
    return chain


def forward(model: Model, q: Array) -> Array:
    """Return T_base_flange (4, 4) at joints q (7,) in radians."""
    return frames(model, q)[-1]


def jacobian(chain: list[Array]) -> Array:
    """Return the geometric Jacobian (6, 7) of the flange: linear rows, then angular rows."""
    point = chain[-1][:3, 3]
    axes = [T[:3, 2] for T in chain[:-1]]
    return np.array([[*np.cross(z, point - T[:3, 3]), *z] for z, T in zip(axes, chain, strict=False)]).T


def inverse(model: Model, T_base_flange: Array, near: Array) -> Array | None:
    """Return joints (7,) within the limits that reach the pose, by damped steps from `near`; None if it fails."""
    q, limits = near.copy(), np.array(model.limits_rad)
    for _ in range(200):
        chain = frames(model, q)
        turn = T_base_flange[:3, :3] @ chain[-1][:3, :3].T
        w = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        error = np.concatenate([T_base_flange[:3, 3] - chain[-1][:3, 3], w])
        if float(np.max(np.abs(error))) < 1e-10:
            return q if np.all(np.abs(q) <= limits) and np.trace(turn) > 0 else None
        J = jacobian(chain)
        step = J.T @ np.linalg.solve(J @ J.T + 1e-5 * np.eye(6), error)
        q = np.clip(q + step * min(1.0, 0.3 / max(float(np.max(np.abs(step))), 1e-9)), -limits, limits)
    return None


def to_abc(R: Array) -> tuple[float, float, float]:
    """KUKA's angles A, B, C in radians with R = Rz(A) Ry(B) Rx(C)."""
    flat = math.hypot(R[0, 0], R[1, 0])
    b = math.atan2(-R[2, 0], flat)
    if flat < 1e-9:
        return math.atan2(-R[0, 1], R[1, 1]), b, 0.0
    return math.atan2(R[1, 0], R[0, 0]), b, math.atan2(R[2, 1], R[2, 2])
