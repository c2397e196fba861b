"""Images without any pose are located by the spheres that they show."""

from __future__ import annotations

import numpy as np
import pytest

from service.compute.hand_held import poses_by_spheres
from service.compute.markers.records import SphereOutline
from service.compute.scene import ScanSpheres
from service.core.errors import ComputeError
from service.core.geometry import Transform, inverse, look_at, rotation_angle_rad, transform
from tests.support.runs.measuring_rig import SPHERES_M
from tests.support.scenes.sphere_images import Scene, camera, exact_outlines

CAMERA = camera(1200)
RADIUS_M = 0.015
MIDDLE_M = SPHERES_M.mean(axis=0)
T_scan_world = transform(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([0.3, -0.2, 0.1]))
SCANNED = ScanSpheres(SPHERES_M @ T_scan_world[:3, :3].T + T_scan_world[:3, 3], RADIUS_M)


def turned(azimuth_deg: float) -> Transform:
    """T_world_camera 0.7 m from the middle, as on a turntable."""
    azimuth = np.radians(azimuth_deg)
    way = np.array([0.6 * np.cos(azimuth), 0.6 * np.sin(azimuth), 0.8])
    return look_at(MIDDLE_M + 0.7 * way, MIDDLE_M, np.array([0.0, 0.0, 1.0]))


NAMES = [f"t_{k}" for k in range(6)]
POSES = [turned(60.0 * k + 10.0) for k in range(6)]


def outlines(noise_px: float) -> list[tuple[SphereOutline, ...]]:
    made = Scene(np.eye(4), np.array(POSES), CAMERA)
    return [exact_outlines(made, k, SPHERES_M, noise_px, margin_px=30)[0] for k in range(len(POSES))]


def test_each_image_is_located_in_the_frame_of_the_scan() -> None:
    found = poses_by_spheres(outlines(0.1), NAMES, CAMERA, SCANNED)
    assert sorted(found) == NAMES
    for name, true in zip(NAMES, POSES, strict=True):
        gap = inverse(T_scan_world @ true) @ found[name]
        assert np.linalg.norm(gap[:3, 3]) < 1e-3
        assert rotation_angle_rad(gap) < np.radians(0.15)


def test_an_image_that_shows_too_few_spheres_is_left_out() -> None:
    seen = outlines(0.1)
    found = poses_by_spheres([seen[0], seen[1][:3], *seen[2:]], NAMES, CAMERA, SCANNED)
    assert sorted(found) == [name for name in NAMES if name != "t_1"]


def test_images_without_the_spheres_are_an_error_that_counts_them() -> None:
    with pytest.raises(ComputeError, match="too few spheres are visible"):
        poses_by_spheres([mine[:2] for mine in outlines(0.1)], NAMES, CAMERA, SCANNED)
