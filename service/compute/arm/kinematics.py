"""Kinematics of arms from their published Denavit–Hartenberg parameters: forward, derivatives, numeric inverse."""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches

import numpy as np

from service.compute.descent import Damping, largest, levenberg_marquardt
from service.core.errors import ConfigurationError, DataError
from service.core.geometry import Array, Transform, inverse, rotation_angle_rad, to_rotation_vector

JOINT_LIMIT_RAD = 2 * np.pi
_LONGEST_STEP_RAD = 0.4
_REACHED = 1e-7  # m and rad


@dataclass(frozen=True, slots=True)
class ArmModel:
    """An arm's nominal DH parameters in the classic convention: T_(i-1)_i = Rz(θ_i) Tz(d_i) Tx(a_i) Rx(α_i).

    Attributes:
        name: the manufacturer's.
        a_m: (6,) link lengths.
        d_m: (6,) link offsets.
        alpha_rad: (6,) link twists.
    """

    name: str
    a_m: Array
    d_m: Array
    alpha_rad: Array

    def joint_values(self, joints_rad: Array) -> Array:
        """(N, 6, 4) nominal a, d, α, θ for joints (N, 6)."""
        rest = np.stack([self.a_m, self.d_m, self.alpha_rad], axis=1)
        return np.concatenate([np.broadcast_to(rest, (len(joints_rad), 6, 3)), joints_rad[:, :, None]], axis=2)


def _universal_robot(name: str, a2: float, a3: float, d1: float, d4: float, d5: float, d6: float) -> ArmModel:
    half = np.pi / 2
    return ArmModel(
        name,
        np.array([0, a2, a3, 0, 0, 0]),
        np.array([d1, 0, 0, d4, d5, d6]),
        np.array([half, 0, 0, half, -half, 0]),
    )


# Source: Universal Robots, "DH parameters for calculations of kinematics and dynamics" (support article).
_ARMS = {
    arm.name.lower(): arm
    for arm in (
        _universal_robot("UR3e", -0.24355, -0.2132, 0.15185, 0.13105, 0.08535, 0.0921),
        _universal_robot("UR5e", -0.425, -0.3922, 0.1625, 0.1333, 0.0997, 0.0996),
        _universal_robot("UR10e", -0.6127, -0.57155, 0.1807, 0.17415, 0.11985, 0.11655),
        _universal_robot("UR16e", -0.4784, -0.36, 0.1807, 0.17415, 0.11985, 0.11655),
        _universal_robot("UR20", -0.8620, -0.7287, 0.2363, 0.2010, 0.1593, 0.1543),
        _universal_robot("UR30", -0.6370, -0.5037, 0.2363, 0.2010, 0.1593, 0.1543),
        _universal_robot("UR3", -0.24365, -0.21325, 0.1519, 0.11235, 0.08535, 0.0819),
        _universal_robot("UR5", -0.425, -0.39225, 0.089159, 0.10915, 0.09465, 0.0823),
        _universal_robot("UR10", -0.612, -0.5723, 0.1273, 0.163941, 0.1157, 0.0922),
    )
}


#: Names of the arms with known kinematics.
ARM_MODELS = tuple(arm.name for arm in _ARMS.values())


def arm_model(name: str) -> ArmModel:
    """The arm of this name, in upper or lower case.

    Raises:
        ConfigurationError: the name is unknown.
    """
    try:
        return _ARMS[name.lower()]
    except KeyError:
        near = get_close_matches(name.lower(), _ARMS, n=1)
        hint = f"did you mean {_ARMS[near[0]].name}? " if near else ""
        known = ", ".join(ARM_MODELS)
        raise ConfigurationError(
            f"no kinematics are known for an arm {name!r}", remedy=f"{hint}known are {known}"
        ) from None


def matching_arm(joints_rad: Array, T_base_flange: Array, *, within_m: float = 0.02) -> ArmModel | None:
    """The arm whose forward kinematics fit the reported poses best; None if none is within `within_m`.

    Args:
        joints_rad: (N, 6).
        T_base_flange: (N, 4, 4) as reported by the controller with the tool centre point at the flange.
        within_m: largest accepted median distance of the positions.
    """
    best, best_m = None, within_m
    for arm in _ARMS.values():
        apart = forward(arm, joints_rad)[:, :3, 3] - T_base_flange[:, :3, 3]
        median = float(np.median(np.linalg.norm(apart, axis=1)))
        if median < best_m:
            best, best_m = arm, median
    return best


def chain(values: Array) -> Array:
    """(N, 7, 4, 4) T_base_0 … T_base_6 from DH values (N, 6, 4) in the order a, d, α, θ."""
    frames = np.zeros((len(values), 7, 4, 4))
    frames[:, 0] = np.eye(4)
    for i in range(6):
        a, d, alpha, theta = values[:, i].T
        ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        zero, one = np.zeros_like(a), np.ones_like(a)
        link = np.array(
            [
                [ct, -st * ca, st * sa, a * ct],
                [st, ct * ca, -ct * sa, a * st],
                [zero, sa, ca, d],
                [zero, zero, zero, one],
            ]
        ).transpose(2, 0, 1)
        frames[:, i + 1] = frames[:, i] @ link
    return frames


def forward(arm: ArmModel, joints_rad: Array) -> Array:
    """(N, 4, 4) T_base_flange at joints (N, 6) with the nominal parameters."""
    return chain(arm.joint_values(_joints(joints_rad)))[:, 6]


def dh_jacobian(frames: Array) -> Array:
    """(N, 6, 24) derivative of the flange's pose by a, d, α, θ of joint 1, of joint 2, …

    The pose increment is (d in metres, w in radians) in the flange's axes, about its origin.

    Args:
        frames: (N, 7, 4, 4) as from `chain`.
    """
    R_flange, flange = frames[:, 6, :3, :3], frames[:, 6, :3, 3]
    J = np.zeros((len(frames), 6, 24))
    to_flange = np.swapaxes(R_flange, 1, 2)
    for i in range(6):
        z, before = frames[:, i, :3, 2], frames[:, i, :3, 3]
        x, after = frames[:, i + 1, :3, 0], frames[:, i + 1, :3, 3]
        columns = (
            (x, np.zeros_like(x)),
            (z, np.zeros_like(z)),
            (np.cross(x, flange - after), x),
            (np.cross(z, flange - before), z),
        )
        for k, (shift, turn) in enumerate(columns):
            J[:, :3, 4 * i + k] = np.einsum("nij,nj->ni", to_flange, shift)
            J[:, 3:, 4 * i + k] = np.einsum("nij,nj->ni", to_flange, turn)
    return J


def solve_joints(arm: ArmModel, T_base_flange: Transform, starts_rad: Array) -> Array | None:
    """Joints (6,) that reach a pose, by damped Newton steps from each start (S, 6) in turn; None if none converges.

    The result is within ±360°. For planning only: whether the arm reaches the pose in a posture near the starts.
    Every step is taken with the same damping, since on a long way round the error may grow for a while.
    """

    def at(q: Array) -> _Reach:
        frames = chain(arm.joint_values(q[None]))
        return _Reach(q, frames, to_rotation_vector(inverse(frames[0, 6]) @ T_base_flange))

    def candidate(here: _Reach, damping: float) -> _Reach:
        J = dh_jacobian(here.frames)[0, :, 3::4]
        step = J.T @ np.linalg.solve(J @ J.T + damping * np.eye(6), here.error)
        return at(here.q + step * min(1.0, _LONGEST_STEP_RAD / max(largest(step), 1e-12)))

    for start in np.atleast_2d(starts_rad):
        found = levenberg_marquardt(
            at(np.array(start, dtype=np.float64)),
            candidate,
            lambda _here, _there: 0.0,
            lambda _here, there: largest(there.error) < _REACHED,
            damping=Damping(1e-6, down=1.0),
            most=40,
        )
        if found.settled:
            return found.state.q if largest(found.state.q) <= JOINT_LIMIT_RAD else None
    return None


@dataclass(frozen=True, slots=True)
class _Reach:
    """Joints (6,), the frames of their links, and the pose's error (6,) there, m and rad."""

    q: Array
    frames: Array
    error: Array


def pose_gap(arm: ArmModel, joints_rad: Array, T_base_flange: Array) -> tuple[float, float]:
    """Median distance (m) and angle (rad) between forward kinematics and the reported poses (N, 4, 4).

    Raises:
        DataError: the numbers of joints and poses differ.
    """
    joints = _joints(joints_rad)
    if len(joints) != len(T_base_flange):
        raise DataError(f"{len(joints)} joint positions for {len(T_base_flange)} poses")
    gap = np.array([inverse(a) @ b for a, b in zip(forward(arm, joints), T_base_flange, strict=True)])
    turn = [rotation_angle_rad(T) for T in gap]
    return float(np.median(np.linalg.norm(gap[:, :3, 3], axis=1))), float(np.median(turn))


def _joints(joints_rad: Array) -> Array:
    joints = np.asarray(joints_rad, dtype=np.float64)
    if joints.ndim != 2 or joints.shape[1] != 6 or not np.isfinite(joints).all():
        raise DataError(f"joint positions {joints.shape}, (N, 6) finite numbers are needed")
    return joints
