"""Camera poses from the poses of several arms, each with its own mount."""

from __future__ import annotations

import numpy as np
import pytest

from service.computations.inputs import robot_camera_poses
from service.computations.records import FurtherArm, Mounting, PosedPhotograph, matrix
from service.computations.registration import DETECT_SPHERES, DetectSpheresArguments
from service.core.geometry import Array
from service.core.jobs import Reference
from service.steps.context import JobRequest


def shifted(x_m: float) -> Array:
    T = np.eye(4)
    T[0, 3] = x_m
    return T


FLANGE = shifted(0.5)
IMAGES = [
    PosedPhotograph(viewpoint=name, sha256="0" * 64, station=station, T_base_flange=matrix(FLANGE))
    for name, station in (("v1", "station_1"), ("v2", "station_2"), ("v3", "station_3"))
]


def test_each_image_is_placed_by_the_mount_of_the_arm_at_its_station() -> None:
    second = FurtherArm(T_flange_camera=matrix(shifted(0.2)), stations=("station_2",))
    mounting = Mounting(T_flange_camera=matrix(shifted(0.1)), arm_correction=None, further_arms=(second,))
    x_m = robot_camera_poses(mounting, IMAGES)[:, 0, 3]
    assert x_m == pytest.approx([0.6, 0.7, 0.6])


def test_the_mount_of_a_further_arm_is_recorded_as_a_reference() -> None:
    second = FurtherArm(T_flange_camera=matrix(shifted(0.2)), stations=("station_2",))
    mounting = Mounting(T_flange_camera=matrix(shifted(0.1)), further_arms=(second,))
    reference = Reference("job-7", "result/T_flange_camera")
    arguments = DetectSpheresArguments.model_construct(**mounting.set_fields())
    request = JobRequest.of(DETECT_SPHERES, arguments, {"further_arms/0/T_flange_camera": reference})
    assert request.arguments["further_arms"] == [
        {"T_flange_camera": reference.record(), "stations": ["station_2"]},
    ]
