"""Computes the kinematics of arms, forward and inverse, and corrects poses by an arm's systematic error."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from service.compute.descent import Damping, largest, levenberg_marquardt
from service.core import seven_axes
from service.core.arms import ArmModel, arm_model, known_arms
from service.core.errors import DataError
from service.core.geometry import Array, Transform, inverse, rotation_angle_rad, to_rotation_vector
from service.core.units import mm

_LONGEST_STEP_RAD = 0.4
_REACHED = 1e-7  # m and rad
_SAME_TOOL_M, _SAME_TOOL_RAD = 0.01, 0.01  # between the tools of most poses, if they are one


def matching_arm(joints_rad: Array, T_base_flange: Array, *, within_m: float = 0.02) -> ArmModel | None:
    """Return the arm whose forward kinematics fit the reported poses best; None if none is within `within_m`.

    Of arms with the same dimensions, such as KUKA's LBR iiwa 14 and LBR Med 14, it is the first.

    Args:
        joints_rad: (N, J); only arms of J axes are considered.
        T_base_flange: (N, 4, 4) poses as the controller reports them with the tool centre point at the flange.
        within_m: largest accepted median distance of the positions.
    """
    best, best_m = None, within_m
    for arm in (arm for arm in known_arms() if arm.axes == joints_rad.shape[1]):
        apart = forward(arm, joints_rad)[:, :3, 3] - T_base_flange[:, :3, 3]
        median = float(np.median(np.linalg.norm(apart, axis=1)))
        if median < best_m:
            best, best_m = arm, median
    return best


def active_tool(joints_rad: Array, T_base_tool: Array) -> tuple[ArmModel, Transform] | None:
    """Find the arm and its tool T_flange_tool with these poses; None if no known arm with one fixed tool has them.

    Args:
        joints_rad: (N, J) joint angles.
        T_base_tool: (N, 4, 4) poses as a controller with an active tool centre point reports them.
    """
    best: tuple[float, ArmModel, Transform] | None = None
    for arm in (arm for arm in known_arms() if arm.axes == joints_rad.shape[1]):
        tools = np.array([inverse(T) for T in forward(arm, joints_rad)]) @ T_base_tool
        usual = tools[np.argsort(tools[:, 0, 3])[len(tools) // 2]]
        apart_m = float(np.median(np.linalg.norm(tools[:, :3, 3] - usual[:3, 3], axis=1)))
        turn_rad = float(np.median([rotation_angle_rad(inverse(usual) @ tool) for tool in tools]))
        if apart_m < _SAME_TOOL_M and turn_rad < _SAME_TOOL_RAD and (best is None or apart_m < best[0]):
            best = apart_m, arm, usual
    return None if best is None else best[1:]


def chain(values: Array) -> Array:
    """Return (N, J + 1, 4, 4) T_base_0 … T_base_J from values (N, J, 4 or 5) in the order a, d, α, θ and any β.

    T_(i-1)_i = Rz(θ) Tz(d) Tx(a) Ry(β) Rx(α).
    """
    axes = values.shape[1]
    frames = np.zeros((len(values), axes + 1, 4, 4))
    frames[:, 0] = np.eye(4)
    for i in range(axes):
        a, d, alpha, theta = values[:, i, :4].T
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
        if values.shape[2] == 5:
            cb, sb = np.cos(values[:, i, 4]), np.sin(values[:, i, 4])
            turn = np.array([[cb, sb * sa, sb * ca], [zero, ca, -sa], [-sb, cb * sa, cb * ca]])
            spin = np.array([[ct, -st, zero], [st, ct, zero], [zero, zero, one]])
            link[:, :3, :3] = spin.transpose(2, 0, 1) @ turn.transpose(2, 0, 1)
        frames[:, i + 1] = frames[:, i] @ link
    return frames


def forward(arm: ArmModel, joints_rad: Array) -> Array:
    """Return (N, 4, 4) T_base_flange at joints (N, J) with the nominal parameters."""
    return chain(arm.joint_values(_joints(arm, joints_rad)))[:, -1]


def dh_jacobian(frames: Array) -> Array:
    """Return (N, 6, 4 J) derivative of the flange's pose by a, d, α, θ of joint 1, of joint 2, …

    The pose increment is (d in metres, w in radians) in the flange's axes, about its origin.

    Args:
        frames: (N, J + 1, 4, 4) frames from `chain`.
    """
    R_flange, flange = frames[:, -1, :3, :3], frames[:, -1, None, :3, 3]
    z, before = frames[:, :-1, :3, 2], frames[:, :-1, :3, 3]
    x, after = frames[:, 1:, :3, 0], frames[:, 1:, :3, 3]
    none = np.zeros_like(x)
    shifts = np.stack([x, z, np.cross(x, flange - after), np.cross(z, flange - before)], axis=2)
    turns = np.stack([none, none, x, z], axis=2)
    moved = np.concatenate([np.einsum("nji,nakj->niak", R_flange, rows) for rows in (shifts, turns)], axis=1)
    return moved.reshape(len(frames), 6, -1)


def parallel_jacobian(frames: Array, joints: Sequence[int]) -> Array:
    """Return the (N, 6, K) derivative of the flange's pose by β of K joints, in the format of `dh_jacobian`.

    Args:
        frames: (N, J + 1, 4, 4) frames from `chain`.
        joints: indices, from 0, of the axes to which the next axis is parallel.
    """
    flange = frames[:, -1, :3, 3]
    to_flange = np.swapaxes(frames[:, -1, :3, :3], 1, 2)
    J = np.zeros((len(frames), 6, len(joints)))
    for k, i in enumerate(joints):
        y = np.cross(frames[:, i, :3, 2], frames[:, i + 1, :3, 0])
        J[:, :3, k] = np.einsum("nij,nj->ni", to_flange, np.cross(y, flange - frames[:, i + 1, :3, 3]))
        J[:, 3:, k] = np.einsum("nij,nj->ni", to_flange, y)
    return J


def solve_joints(arm: ArmModel, T_base_flange: Transform, starts_rad: Array) -> Array | None:
    """Find joints (J,) that reach a pose, by damped Newton steps from each start (S, J) in turn; None if none does.

    The result is within the limits. For planning only: whether the arm reaches the pose in a posture near the starts.
    Every step is taken with the same damping, since on a long way round the error may grow for a while.
    """

    def at(q: Array) -> _Reach:
        frames = chain(arm.joint_values(q[None]))
        return _Reach(q, frames, to_rotation_vector(inverse(frames[0, -1]) @ T_base_flange))

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
            return found.state.q if bool(np.all(np.abs(found.state.q) <= arm.limits_rad)) else None
    return None


@dataclass(frozen=True, slots=True)
class _Reach:
    """Joints (J,), the frames of their links, and the pose's error (6,) there, m and rad."""

    q: Array
    frames: Array
    error: Array


def pose_gap(arm: ArmModel, joints_rad: Array, T_base_flange: Array) -> tuple[float, float]:
    """Return the median distance (m) and angle (rad) between forward kinematics and the reported poses (N, 4, 4).

    Raises:
        DataError: the numbers of joints and poses differ.
    """
    joints = _joints(arm, joints_rad)
    if len(joints) != len(T_base_flange):
        raise DataError(f"{len(joints)} joint positions for {len(T_base_flange)} poses")
    gap = np.array([inverse(a) @ b for a, b in zip(forward(arm, joints), T_base_flange, strict=True)])
    turn = [rotation_angle_rad(T) for T in gap]
    return float(np.median(np.linalg.norm(gap[:, :3, 3], axis=1))), float(np.median(turn))


def _joints(arm: ArmModel, joints_rad: Array) -> Array:
    joints = np.asarray(joints_rad, dtype=np.float64)
    if joints.ndim != 2 or joints.shape[1] != arm.axes or not np.isfinite(joints).all():
        raise DataError(f"joint positions {joints.shape}, (N, {arm.axes}) finite numbers are needed for a {arm.name}")
    return joints


_REACH_TOLERANCE = 1e-9
# Of the squared turns. The last joint turns little but the camera about itself: a whole turn of it is better than
# another side of shoulder, elbow or wrist, from which the ways to the next poses are long or blocked.
_WEIGHTS = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 0.25])


def postures(arm: ArmModel, T_base_flange: Transform) -> Array:
    """Return the joints (K, N) within ±180° and the limits that reach a pose; an empty array if there are none.

    Up to eight for six axes; for seven, those of elbow angles all round.
    """
    if arm.family == "seven_axes":
        return seven_axes.postures(arm, T_base_flange)
    found = _universal_robot(arm, T_base_flange)
    return found[np.all(np.abs(found) <= arm.limits_rad, axis=1)]


def postures_near(arm: ArmModel, T_base_flange: Transform, near_rad: Array) -> Array:
    """Return the joints (K, N) within the limits that reach a pose, those nearest to `near_rad` (N,) first.

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
    """Return the first of `postures_near`; None if the pose is out of reach."""
    found = postures_near(arm, T_base_flange, near_rad)
    return found[0] if len(found) else None


def _universal_robot(arm: ArmModel, T_base_flange: Transform) -> Array:
    """Return the joints (K, 6), K ≤ 8, within ±180°, that reach a pose; an empty array if there are none.

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


_MODEL_GAP_M, _MODEL_GAP_RAD = 0.02, np.radians(3.0)
_PLACE = "arm_correction of the hand-eye calibration"
_REMEDY = "Calibrate hand and eye again"


@dataclass(frozen=True, slots=True)
class ArmCorrection:
    """The difference between the flange's true pose and the controller's, as a function of the joints.

    Attributes:
        arm: name of the arm model to whose nominal parameters these are added.
        dh_deltas: (N, 5) added to a, d (metres), α, θ, β (radians) of each joint; β is that of `ArmModel.parallel`.
        gear_cos_rad: (N, H) amplitudes of cos(k q), k = 1 … H, added to each joint's angle.
        gear_sin_rad: (N, H) amplitudes of sin(k q).
        observed: (N,) share of each joint's error that the images determine, 0 … 1: 1 - posterior / prior variance,
            over the terms in use.

    Raises:
        DataError: the arrays' shapes are inconsistent.
    """

    arm: str
    dh_deltas: Array
    gear_cos_rad: Array
    gear_sin_rad: Array
    observed: Array

    def __post_init__(self) -> None:
        axes = len(self.observed) if self.observed.ndim == 1 else 0
        if (
            axes == 0
            or self.dh_deltas.shape != (axes, 5)
            or self.gear_cos_rad.ndim != 2
            or len(self.gear_cos_rad) != axes
            or self.gear_cos_rad.shape != self.gear_sin_rad.shape
        ):
            raise DataError("not an arm correction: the shapes are inconsistent", where=_PLACE, remedy=_REMEDY)


@dataclass(frozen=True, slots=True)
class CorrectedMounting:
    """An arm's correction, and the camera's pose on the flange that belongs to corrected poses."""

    correction: ArmCorrection
    T_flange_camera: Transform

    def T_base_camera(self, joints_rad: Array, T_base_flange: Array) -> Array:
        """Return (N, 4, 4) camera poses from joints (N, J) and reported poses (N, 4, 4).

        Raises:
            DataError: joints and poses of another arm.
        """
        return corrected_T_base_flange(joints_rad, T_base_flange, self.correction) @ self.T_flange_camera


def corrected_T_base_flange(joints_rad: Array, T_base_flange: Array, correction: ArmCorrection) -> Array:
    """Return the arm's true poses: reported poses times the difference between corrected and nominal kinematics.

    Args:
        joints_rad: (J,) or (N, J) as reported by the controller.
        T_base_flange: (4, 4) or (N, 4, 4) as reported by the controller.
        correction: the correction estimated by a hand-eye calibration of the same arm.

    Returns:
        Corrected poses in the shape of `T_base_flange`.

    Raises:
        DataError: the numbers of joints and poses differ, or they are another arm's.
    """
    joints, poses = np.asarray(joints_rad, dtype=np.float64), np.asarray(T_base_flange, dtype=np.float64)
    if poses.ndim == 2:
        return corrected_T_base_flange(joints[None], poses[None], correction)[0]
    arm = arm_model(correction.arm)
    check_arm(arm, joints, poses)
    if len(correction.dh_deltas) != arm.axes:
        raise DataError(
            f"a correction of {len(correction.dh_deltas)} joints for a {arm.name}", where=_PLACE, remedy=_REMEDY
        )
    before, after = chain(arm.joint_values(joints))[:, -1], chain(_real(arm, joints, correction))[:, -1]
    R_t = np.swapaxes(before[:, :3, :3], 1, 2)
    gap = np.broadcast_to(np.eye(4), before.shape).copy()
    gap[:, :3, :3] = R_t @ after[:, :3, :3]
    gap[:, :3, 3] = np.einsum("nij,nj->ni", R_t, after[:, :3, 3] - before[:, :3, 3])
    return poses @ gap


def _real(arm: ArmModel, joints_rad: Array, correction: ArmCorrection) -> Array:
    """Return (N, J, 4 or 5) a, d, α, θ and, where an axis needs it, β of the arm as it is built, at joints (N, J)."""
    phase = joints_rad[:, :, None] * np.arange(1, correction.gear_cos_rad.shape[1] + 1)
    gears = np.sum(correction.gear_cos_rad * np.cos(phase) + correction.gear_sin_rad * np.sin(phase), axis=2)
    real = np.zeros((*joints_rad.shape, 5))
    real[:, :, :4] = arm.joint_values(joints_rad)
    real += correction.dh_deltas
    real[:, :, 3] += gears
    return real if correction.dh_deltas[:, 4].any() else real[:, :, :4]


def check_arm(arm: ArmModel, joints_rad: Array, T_base_flange: Array) -> None:
    """Refuse joints of another arm, or poses of a tool instead of the flange.

    Raises:
        DataError: forward kinematics and reported poses are too far apart.
    """
    distance_m, angle_rad = pose_gap(arm, joints_rad, T_base_flange)
    if distance_m > _MODEL_GAP_M or angle_rad > _MODEL_GAP_RAD:
        raise DataError(
            f"the poses are {mm(distance_m):.0f} mm and {np.degrees(angle_rad):.1f}° off the forward kinematics "
            f"of a {arm.name}",
            remedy="Check the arm's model, that the poses are the flange's (tool centre point zero), and radians",
        )


def dh_count(arm: ArmModel) -> int:
    """Return how many parameters the geometry of an arm has in `correction_design`."""
    return 4 * arm.axes + len(arm.parallel)


def gear_count(arm: ArmModel) -> int:
    """Return how many parameters the gears of an arm have in `correction_design`."""
    return arm.axes * 2 * arm.tolerances.harmonics


def dh_joints(arm: ArmModel) -> NDArray[np.int64]:
    """Return (`dh_count`,) joint of each parameter of the geometry, from 0."""
    return np.concatenate([np.repeat(np.arange(arm.axes), 4), np.array(arm.parallel, dtype=np.int64)])


def correction_design(arm: ArmModel, joints_rad: Array, about: ArmCorrection) -> Array:
    """Return (N, 6, `dh_count` + `gear_count`) derivative of the flange's pose by all parameters, in tolerances.

    Columns: DH deltas joint by joint (a, d, α, θ), β of those that have it, then for each joint cos(k q), then
    sin(k q), k = 1 … `harmonics`. It is taken for the arm with the errors `about`: twists of half a degree are so
    large that the derivative at the nominal arm leaves some hundredths of a millimetre.
    """
    frames = chain(_real(arm, joints_rad, about))
    J = dh_jacobian(frames)
    phase = joints_rad[:, :, None] * np.arange(1, arm.tolerances.harmonics + 1)
    waves = np.stack([np.cos(phase), np.sin(phase)], axis=2)  # (N, joints, 2, H)
    gears = J[:, :, 3::4, None, None] * waves[:, None]  # (N, 6 rows, joints, 2, H)
    dh = np.concatenate([J, parallel_jacobian(frames, arm.parallel)], axis=2) * _dh_tolerances(arm)
    return np.concatenate([dh, gears.reshape(len(J), 6, -1) * arm.tolerances.gear_rad], axis=2)


def _dh_tolerances(arm: ArmModel) -> Array:
    """Return (`dh_count`,) one standard deviation of each parameter of the geometry.

    Those of the last joint are zero: its errors move the camera with the flange, and nothing can distinguish them
    from another mount of the camera. They stay in T_flange_camera, for whose purpose they are no errors.
    """
    of = np.tile(arm.tolerances.dh, (arm.axes, 1))
    if arm.tolerances.lengths_m:
        of[:, :2] = arm.tolerances.lengths_m
    if arm.tolerances.twists_rad:
        of[:, 2] = arm.tolerances.twists_rad
    of[-1] = 0.0
    return np.concatenate([of.ravel(), np.full(len(arm.parallel), arm.tolerances.parallel_rad)])


def correction_of(arm: ArmModel, scaled: Array, observed: Array) -> ArmCorrection:
    """Return the correction from scaled parameters in the order of `correction_design`, with or without the gears."""
    count, of = dh_count(arm), arm.tolerances
    waves = np.zeros(gear_count(arm))
    waves[: len(scaled) - count] = scaled[count:]
    gears = waves.reshape(arm.axes, 2, of.harmonics) * of.gear_rad
    geometry = scaled[:count] * _dh_tolerances(arm)
    deltas = np.zeros((arm.axes, 5))
    deltas[:, :4] = geometry[: 4 * arm.axes].reshape(arm.axes, 4)
    deltas[list(arm.parallel), 4] = geometry[4 * arm.axes :]
    return ArmCorrection(arm.name, deltas, gears[:, 0].copy(), gears[:, 1].copy(), observed)
