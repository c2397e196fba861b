"""Camera poses from robot poses, with the hand-eye transform and, if there is one, the arm's correction."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from service.core.geometry import Array
from service.jobs.records import ArmCorrection, Mounting, PosedPhotograph
from service.worker.calibration.records import corrected_mounting


def robot_camera_poses(mounting: Mounting, images: Sequence[PosedPhotograph]) -> Array:
    """(N, 4, 4) T_base_camera of a job's images, each in the base frame of its station.

    Args:
        mounting: of the camera on the arm.
        images: with `T_scene_camera` of a hand-held camera, or with `T_base_flange`; for a correction also with
            `station` and `joints_rad`.

    Raises:
        DataError: the joints are not of the corrected arm.
    """
    if all(image.T_scene_camera is not None for image in images):  # hand-held, located by the spheres
        return np.array([image.T_scene_camera for image in images], dtype=np.float64)
    flange = np.array([image.T_base_flange for image in images], dtype=np.float64)
    poses = flange @ np.array(mounting.T_flange_camera, dtype=np.float64)
    correction = mounting.arm_correction
    if correction is not None:
        stations = mounting.arm_stations if mounting.arm_stations is not None else correction.stations or ()
        _correct(poses, correction, flange, images, _stood_at(images, stations))
    for arm in mounting.further_arms:
        mine = _stood_at(images, arm.stations)
        poses[mine] = flange[mine] @ np.array(arm.T_flange_camera, dtype=np.float64)
        if arm.arm_correction is not None:
            _correct(poses, arm.arm_correction, flange, images, mine)
    return poses


def _stood_at(images: Sequence[PosedPhotograph], stations: Sequence[str]) -> NDArray[np.bool_]:
    return np.array([image.station in stations for image in images], dtype=np.bool_)


def _correct(
    poses: Array, correction: ArmCorrection, flange: Array, images: Sequence[PosedPhotograph], mine: NDArray[np.bool_]
) -> None:
    """Replace the poses of one arm's images by corrected ones."""
    if mine.any():
        joints = np.array([image.joints_rad for image, own in zip(images, mine, strict=True) if own])
        poses[mine] = corrected_mounting(correction).T_base_camera(joints, flange[mine])
