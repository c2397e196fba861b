"""Camera poses from the robot's: through the hand-eye, and through the arm's correction where there is one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from service.compute.calibration.hand_eye.record import read_arm_correction
from service.core.geometry import Array
from service.jobs.records import Mounting, Photograph


def robot_camera_poses(mounting: Mounting, images: Sequence[Photograph]) -> Array:
    """(N, 4, 4) T_base_camera of a job's images, each in the base frame of its station.

    Args:
        mounting: how the camera sat on the arm.
        images: with `T_scene_camera` of a hand-held camera, or with `T_base_flange`, and for a correction `station`
            and `joints_rad`.

    Raises:
        DataError: joints of another arm than the correction's.
    """
    if all(image.T_scene_camera is not None for image in images):  # hand-held: by the spheres of each image
        return np.array([image.T_scene_camera for image in images], dtype=np.float64)
    flange = np.array([image.T_base_flange for image in images], dtype=np.float64)
    poses = flange @ np.array(mounting.T_flange_camera, dtype=np.float64)
    correction = mounting.arm_correction
    if correction is None:
        return poses
    stations = mounting.arm_stations if mounting.arm_stations is not None else correction.stations or ()
    mine = np.array([image.station in stations for image in images])
    if mine.any():
        joints = np.array([image.joints_rad for image, own in zip(images, mine, strict=True) if own])
        poses[mine] = read_arm_correction(correction.plain()).T_base_camera(joints, flange[mine])
    return poses
