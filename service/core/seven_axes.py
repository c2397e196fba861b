"""Closed-form inverse kinematics of seven-axis arms with a spherical shoulder and wrist, by elbow angle."""

from __future__ import annotations

from itertools import product

import numpy as np

from service.core.arms import ArmModel, flange_pose
from service.core.geometry import Array, Transform

_ELBOWS = 48  # elbow angles that are tried, 7.5° apart
_REACH = 1e-9
_STRAIGHT = 1e-9
_NEAR_LIMIT_RAD = np.radians(10.0)
_LIMIT_WEIGHT = 10.0  # 10° inside the limit count nothing, at the limit as much as three radians of travel
_NEAR_SINGULAR_RAD = np.radians(12.0)
_SINGULAR_WEIGHT = 2.0
_BENDS = (1, 3, 5)  # shoulder, elbow and wrist: where one is straight, the arm loses a direction


def postures(arm: ArmModel, T_base_flange: Transform, elbow_angles_rad: Array | None = None) -> Array:
    """Return joints (K, 7) within limits that reach a pose, for elbow angles all round; empty if out of reach.

    The elbow angle turns the elbow about the line from the shoulder to the wrist; it is 0 where joint 3 is. For each
    one there are up to eight postures: elbow, shoulder and wrist either way round.

    Source of the redundancy: M. Shimizu et al., "Analytical Inverse Kinematic Computation for 7-DOF Redundant
    Manipulators With Joint Limits", IEEE Transactions on Robotics 24 (2008).
    """
    angles = np.linspace(-np.pi, np.pi, _ELBOWS, endpoint=False) if elbow_angles_rad is None else elbow_angles_rad
    base, upper, fore, hand = arm.d_m[::2]
    wrist = T_base_flange[:3, 3] - hand * T_base_flange[:3, 2] - np.array([0.0, 0.0, base])
    length = float(np.linalg.norm(wrist))
    cosine4 = (length**2 - upper**2 - fore**2) / (2 * upper * fore)
    if abs(cosine4) > 1 + _REACH or length < _STRAIGHT:
        return np.zeros((0, 7))
    bend = float(np.arccos(np.clip(cosine4, -1.0, 1.0)))
    found: list[Array] = []
    for q4 in (bend, -bend):
        R_0_3 = _about(wrist / length, angles) @ _reference(arm, wrist, q4)
        turn4 = _rz(np.array([q4]))[0] @ _rx(-np.pi / 2)
        R_4_7 = np.swapaxes(R_0_3 @ _rx(np.pi / 2) @ turn4, 1, 2) @ T_base_flange[:3, :3]
        for shoulder, wrist_side in product((1, -1), (1, -1)):
            q = np.empty((len(angles), 7))
            q[:, 0:3], q[:, 3], q[:, 4:7] = _zyz(R_0_3, shoulder), q4, _zyz(R_4_7, wrist_side)
            found.append(q)
    every = np.concatenate(found)
    return every[np.all(np.abs(every) <= arm.limits_rad + _REACH, axis=1)]


def nearest_posture(arm: ArmModel, T_base_flange: Transform, near_rad: Array) -> Array | None:
    """Return joints (7,) that reach a pose near `near_rad`, clear of limits and singularities; None if out of reach.

    The elbow angle is the one at `near_rad` unless another brings less motion, or more room.
    """
    found = postures_by_cost(arm, T_base_flange, near_rad)
    return found[0] if len(found) else None


def postures_by_cost(arm: ArmModel, T_base_flange: Transform, near_rad: Array) -> Array:
    """Return joints (K, 7) that reach a pose with the elbow at `near_rad`'s angle and all round, the best first."""
    angles = np.concatenate([[elbow_angle_rad(arm, near_rad)], np.linspace(-np.pi, np.pi, _ELBOWS, endpoint=False)])
    found = postures(arm, T_base_flange, angles)
    return found[np.argsort(posture_costs(arm, found, near_rad), kind="stable")]


def posture_costs(arm: ArmModel, joints_rad: Array, near_rad: Array) -> Array:
    """Return (K,) squared travel (rad²) from `near_rad` to joints (K, 7), plus what limits and singularities cost.

    A joint close to its limit costs, and so does a shoulder, elbow or wrist that is nearly straight.
    """
    room = arm.limits_rad - np.abs(joints_rad)
    short = np.clip(1.0 - room / _NEAR_LIMIT_RAD, 0.0, None)
    # Only coming nearer to a limit than the start costs something: the start itself may lie near one.
    here = np.clip(1.0 - (arm.limits_rad - np.abs(near_rad)) / _NEAR_LIMIT_RAD, 0.0, None)
    limits = _LIMIT_WEIGHT * np.sum(np.clip(short - here, 0.0, None) ** 2, axis=1)
    return np.sum((joints_rad - near_rad) ** 2, axis=1) + limits + _singular_costs(joints_rad, near_rad)


def _singular_costs(joints_rad: Array, near_rad: Array) -> Array:
    straight = np.clip(1.0 - np.abs(joints_rad[:, _BENDS]) / _NEAR_SINGULAR_RAD, 0.0, None)
    here = np.clip(1.0 - np.abs(near_rad[list(_BENDS)]) / _NEAR_SINGULAR_RAD, 0.0, None)
    return np.asarray(_SINGULAR_WEIGHT * np.sum(np.clip(straight - here, 0.0, None) ** 2, axis=1), dtype=np.float64)


def elbow_angle_rad(arm: ArmModel, joints_rad: Array) -> float:
    """Return the elbow angle at joints (7,), -π … π."""
    base, _, _, hand = arm.d_m[::2]
    T = flange_pose(arm, joints_rad)
    wrist = T[:3, 3] - hand * T[:3, 2] - np.array([0.0, 0.0, base])
    length = float(np.linalg.norm(wrist))
    if length < _STRAIGHT:
        return 0.0
    R_0_3 = (_rz(joints_rad[:1]) @ _ry(joints_rad[1:2]) @ _rz(joints_rad[2:3]))[0]
    turned = R_0_3 @ _reference(arm, wrist, float(joints_rad[3])).T
    w = np.array([turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]])
    return float(np.arctan2(w @ (wrist / length), np.trace(turned) - 1.0))


def _reference(arm: ArmModel, wrist: Array, q4: float) -> Array:
    """Return the rotation (3, 3) of the upper arm that brings the wrist here (from the shoulder), joint 3 at 0."""
    _, upper, fore, _ = arm.d_m[::2]
    leaning = np.arctan2(np.hypot(wrist[0], wrist[1]), wrist[2])
    q2 = leaning + np.arctan2(fore * np.sin(q4), upper + fore * np.cos(q4))
    return _rz(np.array([np.arctan2(wrist[1], wrist[0])]))[0] @ _ry(np.array([q2]))[0]


def _zyz(R: Array, side: int) -> Array:
    """Return (K, 3) angles with R = Rz Ry Rz, the middle one of this sign; where it is 0 the first is 0."""
    sine = side * np.hypot(R[:, 0, 2], R[:, 1, 2])
    middle = np.arctan2(sine, R[:, 2, 2])
    first = np.arctan2(side * R[:, 1, 2], side * R[:, 0, 2])
    last = np.arctan2(side * R[:, 2, 1], -side * R[:, 2, 0])
    straight = np.abs(sine) < _STRAIGHT
    first = np.where(straight, 0.0, first)
    last = np.where(straight, np.arctan2(R[:, 1, 0], R[:, 1, 1]), last)
    return np.stack([first, middle, last], axis=1)


def _about(axis: Array, angles: Array) -> Array:
    """Return (K, 3, 3) rotations about a unit axis (3,), by Rodrigues' formula."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angles)[:, None, None] * K + (1.0 - np.cos(angles))[:, None, None] * (K @ K)


def _rz(angles: Array) -> Array:
    return _about(np.array([0.0, 0.0, 1.0]), angles)


def _ry(angles: Array) -> Array:
    return _about(np.array([0.0, 1.0, 0.0]), angles)


def _rx(angle: float) -> Array:
    return _about(np.array([1.0, 0.0, 0.0]), np.array([angle]))[0]
