"""Models an arm's systematic error, how it was built and its gears' periodic errors, and corrects poses by it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.compute.arm_kinematics import chain, dh_jacobian, parallel_jacobian, pose_gap
from service.core.arms import ArmModel, arm_model
from service.core.errors import DataError
from service.core.geometry import Array, Transform
from service.core.units import mm

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
