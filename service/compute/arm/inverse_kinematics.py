"""Closed-form inverse kinematics: the postures that reach a pose, and the one that is nearest to another."""

from __future__ import annotations

from itertools import product

import numpy as np

from service.core import seven_axes
from service.core.arms.model import ArmModel
from service.core.geometry import Array, Transform, inverse

_REACH_TOLERANCE = 1e-9
# Of the squared turns. The last joint turns little but the camera about itself: a whole turn of it is better than
# another side of shoulder, elbow or wrist, from which the ways to the next poses are long or blocked.
_WEIGHTS = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 0.25])


def postures(arm: ArmModel, T_base_flange: Transform) -> Array:
    """Joints (K, N) within ±180° and the limits that reach a pose; an empty array if there are none.

    Up to eight for six axes; for seven, those of elbow angles all round.
    """
    if arm.family == "seven_axes":
        return seven_axes.postures(arm, T_base_flange)
    found = _universal_robot(arm, T_base_flange)
    return found[np.all(np.abs(found) <= arm.limits_rad, axis=1)]


def postures_near(arm: ArmModel, T_base_flange: Transform, near_rad: Array) -> Array:
    """Joints (K, N) within the limits that reach a pose, those nearest to `near_rad` (N,) first.

    The turn of the last of six axes counts half. With seven axes nearness is weighed against room to limits and
    singularities.
    """
    if arm.family == "seven_axes":
        return seven_axes.postures_by_cost(arm, T_base_flange, near_rad)
    found = _universal_robot(arm, T_base_flange)
    found = found + 2 * np.pi * np.round((near_rad - found) / (2 * np.pi))
    found = np.where(np.abs(found) > arm.limits_rad, found - 2 * np.pi * np.sign(found), found)
    found = found[np.all(np.abs(found) <= arm.limits_rad, axis=1)]
    return found[np.argsort((found - near_rad) ** 2 @ _WEIGHTS, kind="stable")]


def nearest_posture(arm: ArmModel, T_base_flange: Transform, near_rad: Array) -> Array | None:
    """The first of `postures_near`; None if the pose is out of reach."""
    found = postures_near(arm, T_base_flange, near_rad)
    return found[0] if len(found) else None


def _universal_robot(arm: ArmModel, T_base_flange: Transform) -> Array:
    """Joints (K, 6), K ≤ 8, within ±180°, that reach a pose; an empty array if there are none.

    The eight are shoulder left or right, wrist up or down, elbow up or down. Where the last axis is parallel to the
    second, its angle is free and taken as 0.

    Source: K. P. Hawkins, "Analytic Inverse Kinematics for the Universal Robots UR-5/UR-10 Arms", Georgia Institute
    of Technology, 2013, for the DH parameters of `ArmModel`.
    """
    a2, a3 = float(arm.a_m[1]), float(arm.a_m[2])
    d4, d6 = float(arm.d_m[3]), float(arm.d_m[5])
    wrist = T_base_flange[:3, 3] - d6 * T_base_flange[:3, 2]
    radius = float(np.hypot(wrist[0], wrist[1]))
    if radius < d4:
        return np.zeros((0, 6))
    found: list[Array] = []
    for shoulder, wrist_side in product((1, -1), (1, -1)):
        q1 = float(np.arctan2(wrist[1], wrist[0])) + shoulder * float(np.arccos(d4 / radius)) + np.pi / 2
        s1, c1 = np.sin(q1), np.cos(q1)
        cosine5 = float((T_base_flange[0, 3] * s1 - T_base_flange[1, 3] * c1 - d4) / d6)
        if abs(cosine5) > 1 + _REACH_TOLERANCE:
            continue
        q5 = wrist_side * float(np.arccos(np.clip(cosine5, -1, 1)))
        s5, q6 = np.sin(q5), 0.0
        if abs(s5) > 1e-9:
            x, y = T_base_flange[:3, 0], T_base_flange[:3, 1]
            q6 = float(np.arctan2((-y[0] * s1 + y[1] * c1) / s5, (x[0] * s1 - x[1] * c1) / s5))
        T_1_4 = inverse(_link(arm, 0, q1)) @ T_base_flange @ inverse(_link(arm, 4, q5) @ _link(arm, 5, q6))
        px, py = T_1_4[0, 3] - d4 * T_1_4[0, 1], T_1_4[1, 3] - d4 * T_1_4[1, 1]
        cosine3 = float((px**2 + py**2 - a2**2 - a3**2) / (2 * a2 * a3))
        if abs(cosine3) > 1 + _REACH_TOLERANCE:
            continue
        for elbow in (1, -1):
            q3 = elbow * float(np.arccos(np.clip(cosine3, -1, 1)))
            q2 = float(np.arctan2(py, px)) - float(np.arctan2(a3 * np.sin(q3), a2 + a3 * np.cos(q3)))
            T_3_4 = inverse(_link(arm, 1, q2) @ _link(arm, 2, q3)) @ T_1_4
            found.append(np.array([q1, q2, q3, np.arctan2(T_3_4[1, 0], T_3_4[0, 0]), q5, q6]))
    return np.mod(np.array(found).reshape(-1, 6) + np.pi, 2 * np.pi) - np.pi


def _link(arm: ArmModel, i: int, angle: float) -> Transform:
    c, s = np.cos(angle), np.sin(angle)
    ca, sa, a, d = np.cos(arm.alpha_rad[i]), np.sin(arm.alpha_rad[i]), arm.a_m[i], arm.d_m[i]
    return np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]])
