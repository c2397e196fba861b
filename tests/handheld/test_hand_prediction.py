"""The error that a hand-held capture's screen predicts counts what the error budget of the data set counts."""

from __future__ import annotations

import numpy as np
import pytest

from service.computations.hand_held import HandViewArguments
from service.computations.hand_held.compute import HandGuide, HandheldImage
from service.computations.inputs import CaptureScene
from service.computations.records import Camera, Limits
from service.compute.planning.coverage import CoverageLimits, predicted_information
from service.core.geometry import apply, inverse
from tests.support.scenes.sphere_images import RADIUS_M, REGISTRATION_M, scene

MADE = scene(6, width=1920, seed=2)
POSES = inverse(MADE.T_world_scan) @ MADE.T_world_camera
CENTRE_M = REGISTRATION_M.mean(axis=0)


def taken() -> list[HandheldImage]:
    """Six images, each with the information of all spheres seen to 0.08 px."""
    precise = (0.08 / MADE.camera.fx) ** 2 * np.eye(3)
    return [
        HandheldImage(
            f"v{i}",
            True,
            T,
            np.eye(4),
            predicted_information(T, REGISTRATION_M, RADIUS_M, CENTRE_M, precise),
            np.zeros(0, dtype=bool),
            np.zeros((0, 0), dtype=np.int64),
            None,
            None,
        )
        for i, T in enumerate(POSES)
    ]


def predicted_mm(**counted: object) -> float:
    images = taken()
    place = {"name": "a", "tilt_deg": 20, "azimuth_deg": 0, "distance_m": 0.6, "walk_round": True}
    arguments = HandViewArguments.model_validate(
        {
            "places": [{**place, "aim_m": [0, 0, 0]}],
            "within_deg": 10, "first_words": "", "limits": Limits(max_angle_deg=60, max_distance_m=1, min_views=2),
            "image": {"viewpoint": "v5", "sha256": "0" * 64, "settings": "", "focal_mm": 50},
            "camera": Camera.model_validate(MADE.camera.record()), "spheres_m": REGISTRATION_M.tolist(),
            "radius_m": RADIUS_M, "pose_sigma_m": 5e-5, "pose_sigma_rad": 1e-4, "limit_m": 1e-4, "min_coverage": 0,
            **counted,
        }
    )  # fmt: skip
    there = CaptureScene(MADE.camera, REGISTRATION_M, RADIUS_M, CoverageLimits(60.0, 1.0, 2), None)
    guide = HandGuide(arguments, there, images[-1], images[:-1], images)
    return guide.totals()["predicted_target_error_mm"]


def test_edges_calibration_and_scan_are_counted() -> None:
    bare_mm = predicted_mm()
    light_mm = 1e3 * 0.02 * np.sqrt(3) * np.linalg.norm(POSES[:, :3, 3] - CENTRE_M, axis=1).mean() / MADE.camera.fx
    assert bare_mm > light_mm  # what all outlines share does not average out
    with_scan_mm = predicted_mm(scan_sigma_m=3e-5)
    assert with_scan_mm == pytest.approx(np.hypot(bare_mm, 0.03), rel=1e-6)
    fx, fy = MADE.camera.fx, MADE.camera.fy
    lens = np.diag([(1e-4 * fx) ** 2, (1e-4 * fy) ** 2, 0.1**2, 0.1**2, *[1e-18] * 4])
    of_lens_mm = np.sqrt(predicted_mm(intrinsics_covariance=lens.tolist()) ** 2 - bare_mm**2)
    distance_mm = 1e3 * float(np.linalg.norm(apply(inverse(POSES[0]), CENTRE_M)))
    assert 0.3e-4 * distance_mm < of_lens_mm < 3e-4 * distance_mm
