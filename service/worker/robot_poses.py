"""Camera poses from the robot's: through the hand-eye, and through the arm's correction where there is one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from service.compute.calibration.hand_eye.record import read_arm_correction
from service.core.geometry import Array


def robot_camera_poses(arguments: Mapping[str, Any], images: Sequence[Mapping[str, Any]]) -> Array:
    """(N, 4, 4) T_base_camera of a job's images, each in the base frame of its station.

    Args:
        arguments: of the job, with `T_flange_camera` and perhaps `arm_correction` (steps/inputs.hand_eye_of).
        images: with `T_scene_camera` of a hand-held camera, or with `T_base_flange`, and for a correction `station`
            and `joints_rad`.

    Raises:
        DataError: joints of another arm than the correction's.
    """
    if all("T_scene_camera" in image for image in images):  # hand-held: by the spheres of each image
        return np.array([image["T_scene_camera"] for image in images], dtype=np.float64)
    flange = np.array([image["T_base_flange"] for image in images], dtype=np.float64)
    poses = flange @ np.array(arguments["T_flange_camera"], dtype=np.float64)
    record = arguments.get("arm_correction")
    if record is None:
        return poses
    mine = np.array([image["station"] in record["stations"] for image in images])
    if mine.any():
        joints = np.array([image["joints_rad"] for image, own in zip(images, mine, strict=True) if own])
        poses[mine] = read_arm_correction(record).T_base_camera(joints, flange[mine])
    return poses
