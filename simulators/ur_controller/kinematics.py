"""Kinematics of Universal Robots arms: DH forward kinematics, Jacobian, and analytic inverse kinematics."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

JOINT_LIMIT_RAD = 2 * math.pi
Six = tuple[float, float, float, float, float, float]
_ALPHA_RAD: Six = (math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0)  # of every model, as published
_COS_ALPHA, _SIN_ALPHA = (0.0, 1.0, 1.0, 0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 1.0, -1.0, 0.0)  # exactly
_NONE: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Model:
    """A robot model: its DH parameters, those published by the maker or one calibrated arm's, and its ratings."""

    name: str
    a_m: Six
    d_m: Six
    payload_kg: float
    e_series: bool = True
    theta_rad: Six = _NONE
    alpha_rad: Six = _ALPHA_RAD


def _model(
    name: str, a: tuple[float, float], d: tuple[float, float, float, float], kg: float, *, e_series: bool = True
) -> Model:
    return Model(name, (0, a[0], a[1], 0, 0, 0), (d[0], 0, 0, d[1], d[2], d[3]), kg, e_series)


MODELS = {
    m.name: m
    for m in (
        _model("UR3e", (-0.24355, -0.2132), (0.15185, 0.13105, 0.08535, 0.0921), 3.0),
        _model("UR5e", (-0.425, -0.3922), (0.1625, 0.1333, 0.0997, 0.0996), 5.0),
        _model("UR10e", (-0.6127, -0.57155), (0.1807, 0.17415, 0.11985, 0.11655), 12.5),
        _model("UR16e", (-0.4784, -0.36), (0.1807, 0.17415, 0.11985, 0.11655), 16.0),
        _model("UR20", (-0.8620, -0.7287), (0.2363, 0.2010, 0.1593, 0.1543), 20.0),
        _model("UR30", (-0.6370, -0.5037), (0.2363, 0.2010, 0.1593, 0.1543), 30.0),
        _model("UR3", (-0.24365, -0.21325), (0.1519, 0.11235, 0.08535, 0.0819), 3.0, e_series=False),
        _model("UR5", (-0.425, -0.39225), (0.089159, 0.10915, 0.09465, 0.0823), 5.0, e_series=False),
        _model("UR10", (-0.612, -0.5723), (0.1273, 0.163941, 0.1157, 0.0922), 10.0, e_series=False),
    )
}


def frames(model: Model, q: Array) -> list[Array]:
    """Return T_base_0 … T_base_6 (4, 4) along the chain at joints q (6,) in radians; the last one is the flange."""
    chain = [np.eye(4)]
    for i in range(6):
        chain.append(chain[-1] @ _link(model, i, float(q[i])))
    return chain


def _link(model: Model, i: int, angle: float) -> Array:
    """T_i_(i+1) of the DH table, (4, 4)."""
    turned = angle + model.theta_rad[i]
    c, s, a = math.cos(turned), math.sin(turned), model.a_m[i]
    alpha = model.alpha_rad[i]
    ca, sa = (_COS_ALPHA[i], _SIN_ALPHA[i]) if alpha == _ALPHA_RAD[i] else (math.cos(alpha), math.sin(alpha))
    return np.array(
        [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0.0, sa, ca, model.d_m[i]], [0.0, 0.0, 0.0, 1.0]]
    )


def forward(model: Model, q: Array) -> Array:
    """Return T_base_flange (4, 4) at joints q (6,) in radians."""
    return frames(model, q)[6]


def jacobian(chain: list[Array], point: Array) -> Array:
    """Return the geometric Jacobian (6, 6) of a point (3,) fixed to the flange: linear rows, then angular rows."""
    J = np.empty((6, 6))
    for i in range(6):
        z, p = chain[i][:3, 2], chain[i][:3, 3]
        J[:3, i] = _cross(z, point - p)
        J[3:, i] = z
    return J


def _cross(a: Array, b: Array) -> tuple[float, float, float]:  # np.cross costs 20 µs on vectors of three
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def inverse(model: Model, T_base_flange: Array, near: Array) -> Array | None:
    """Return the joints (6,) that reach the pose, closest to `near` and within ±360°; None if it is unreachable."""
    best: Array | None = None
    best_distance = math.inf
    published = MODELS.get(model.name, model)  # of which the postures have a formula; a calibrated arm's are near
    for candidate in _postures(published, T_base_flange, near):
        q = candidate + 2 * math.pi * np.round((near - candidate) / (2 * math.pi))
        q = np.where(q > JOINT_LIMIT_RAD, q - 2 * math.pi, np.where(q < -JOINT_LIMIT_RAD, q + 2 * math.pi, q))
        distance = float(np.sum((q - near) ** 2))
        # An arc cosine near ±1 loses half the digits: Newton steps restore them, or expose a wrong branch.
        if distance < best_distance and (refined := follow(model, T_base_flange, q)) is not None:
            best, best_distance = refined, distance
    return best


def follow(model: Model, T_base_flange: Array, q: Array) -> Array | None:
    """Return the joints (6,) of the same posture as `q` that reach a nearby pose, by Newton's method.

    Returns None if it diverges.
    """
    for _ in range(8):
        chain = frames(model, q)
        T = chain[6]
        error = np.concatenate(
            [T_base_flange[:3, 3] - T[:3, 3], rotation_vector(T_base_flange[:3, :3] @ T[:3, :3].T)]
        )
        if float(np.max(np.abs(error))) < 1e-11:
            return q
        J = jacobian(chain, T[:3, 3])
        # Damped only where the arm is nearly singular.
        damping = 1e-9 if abs(float(np.linalg.det(J))) < 1e-6 else 0.0
        step = np.linalg.solve(J.T @ J + damping * np.eye(6), J.T @ error) if damping else np.linalg.solve(J, error)
        if float(np.max(np.abs(step))) > 0.5:
            return None
        q = q + step
    return q if float(np.max(np.abs(forward(model, q) - T_base_flange))) < 1e-8 else None


def _postures(model: Model, T: Array, near: Array) -> Iterator[Array]:
    """Yield the up to eight postures: shoulder left or right, wrist up or down, elbow up or down.

    Source: the geometric solution of K. P. Hawkins, "Analytic Inverse Kinematics for the Universal Robots
    UR-5/UR-10 Arms", Georgia Institute of Technology, 2013, with signs for the DH table above.
    """
    a2, a3 = model.a_m[1], model.a_m[2]
    d4, d6 = model.d_m[3], model.d_m[5]
    wrist = T[:3, 3] - d6 * T[:3, 2]
    radius = math.hypot(wrist[0], wrist[1])
    if radius < abs(d4) - 1e-9:
        return
    swing = math.acos(min(1.0, d4 / radius))
    for q1 in (math.atan2(wrist[1], wrist[0]) + side * swing + math.pi / 2 for side in (1, -1)):
        s1, c1 = math.sin(q1), math.cos(q1)
        cosine5 = (T[0, 3] * s1 - T[1, 3] * c1 - d4) / d6
        if abs(cosine5) > 1 + 1e-9:
            continue
        for q5 in (side * math.acos(max(-1.0, min(1.0, cosine5))) for side in (1, -1)):
            s5 = math.sin(q5)
            if abs(s5) < 1e-9:  # the last axis is parallel to axes 2 to 4: any angle is a solution
                q6 = float(near[5])
            else:
                q6 = math.atan2((-T[0, 1] * s1 + T[1, 1] * c1) / s5, (T[0, 0] * s1 - T[1, 0] * c1) / s5)
            T14 = rigid_inverse(_link(model, 0, q1)) @ T @ rigid_inverse(_link(model, 4, q5) @ _link(model, 5, q6))
            x, y = T14[0, 3] - d4 * T14[0, 1], T14[1, 3] - d4 * T14[1, 1]
            cosine3 = (x * x + y * y - a2 * a2 - a3 * a3) / (2 * a2 * a3)
            if abs(cosine3) > 1 + 1e-9:
                continue
            for q3 in (side * math.acos(max(-1.0, min(1.0, cosine3))) for side in (1, -1)):
                q2 = math.atan2(y, x) - math.atan2(a3 * math.sin(q3), a2 + a3 * math.cos(q3))
                T34 = rigid_inverse(_link(model, 1, q2) @ _link(model, 2, q3)) @ T14
                yield np.array([q1, q2, q3, math.atan2(T34[1, 0], T34[0, 0]), q5, q6])


# --- poses: x, y, z in metres and a rotation vector in radians ------------------------------------------


def rotation(vector: Array) -> Array:
    """Rotation matrix (3, 3) of a rotation vector (3,), by Rodrigues' formula."""
    angle = math.sqrt(float(vector @ vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * K + (1.0 - math.cos(angle)) * (K @ K)


def rotation_vector(R: Array) -> Array:
    """Rotation vector (3,), with an angle in 0…π, of a rotation matrix (3, 3)."""
    w = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = 0.5 * math.sqrt(float(w @ w))
    cosine = 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0)
    angle = math.atan2(sine, cosine)
    if sine < 1e-12 and cosine > 0:
        return 0.5 * w
    if cosine > 0 or sine > 1e-4:
        return w * (0.5 * angle / sine)
    # Near a half turn: take the axis from the largest column of R + 1.
    B = 0.5 * (R + R.T) + np.eye(3) * -cosine
    column = B[:, int(np.argmax(np.diag(B)))]
    axis = column / np.linalg.norm(column)
    return axis * angle * (1.0 if float(axis @ w) >= 0.0 else -1.0)


def from_pose(pose: Array) -> Array:
    """Transform (4, 4) of a pose (6,)."""
    T = np.eye(4)
    T[:3, :3] = rotation(np.asarray(pose[3:6], dtype=np.float64))
    T[:3, 3] = pose[:3]
    return T


def to_pose(T: Array) -> Array:
    """Pose (6,) of a transform (4, 4)."""
    return np.concatenate([T[:3, 3], rotation_vector(T[:3, :3])])


def rigid_inverse(T: Array) -> Array:
    """Inverse of a rigid transform (4, 4)."""
    out = np.eye(4)
    out[:3, :3] = T[:3, :3].T
    out[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return out
