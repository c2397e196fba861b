"""Further cameras from exact and noisy outlines: fixed ones in the scan's frame, rigid ones in the first camera's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.compute.registration.further_camera import (
    FurtherPose,
    OuterFrame,
    SightedPose,
    fixed_pose,
    rigid_pose,
    sighted_pose,
)
from service.core.errors import ComputeError
from service.core.geometry import Transform, inverse, transform
from tests.support.scenes.sphere_images import REGISTRATION, REGISTRATION_M, Scene, exact_outlines, scene

T_FIRST_SECOND = transform(Rotation.from_rotvec([0.01, -0.12, 0.02]), np.array([0.08, 0.002, -0.004]))


def seen(made: Scene, noise_px: float, seed: int = 0) -> dict[str, SightedPose]:
    """The poses by single images of a scene."""
    return {
        f"v{i}": sighted_pose(
            exact_outlines(made, i, REGISTRATION_M, noise_px, seed)[0], made.camera, REGISTRATION, None
        )
        for i in range(len(made.T_world_camera))
    }


def on_the_scan(made: Scene) -> Scene:
    """The same scene with the scan as the world."""
    T_scan_world = inverse(made.T_world_scan)
    return replace(made, T_world_scan=np.eye(4), T_world_camera=T_scan_world @ made.T_world_camera)


def off(found: Transform, truth: Transform) -> tuple[float, float]:
    """Distance (m) and angle (rad) between two poses."""
    turned = Rotation.from_matrix(found[:3, :3] @ truth[:3, :3].T).magnitude()
    return float(np.linalg.norm(found[:3, 3] - truth[:3, 3])), float(turned)


def looking(count: int, seed: int) -> Scene:
    """Views far enough away to show all spheres."""
    made = scene(count, seed=seed)
    back = transform(np.eye(3), np.array([0.0, 0.0, -0.25]))
    return on_the_scan(replace(made, T_world_camera=made.T_world_camera @ back))


def first_frames(made: Scene) -> dict[str, OuterFrame]:
    """The first camera, whose pose is known exactly, one mount before the second."""
    return {
        f"v{i}": OuterFrame(T @ inverse(T_FIRST_SECOND), np.zeros((6, 6))) for i, T in enumerate(made.T_world_camera)
    }


def test_exact_outlines_give_the_exact_mount() -> None:
    made = looking(6, 3)
    pose = rigid_pose(seen(made, 0.0), first_frames(made))
    away_m, turned_rad = off(pose.mean.T, T_FIRST_SECOND)
    assert away_m < 1e-6
    assert turned_rad < 1e-6
    assert pose.mean.kept.all()


@pytest.mark.slow
def test_the_mount_is_within_its_stated_covariance() -> None:
    found: list[float] = []
    for seed in range(12):
        made = looking(8, seed)
        pose = rigid_pose(seen(made, 0.1, seed), first_frames(made))
        turned = Rotation.from_matrix(pose.mean.T[:3, :3] @ T_FIRST_SECOND[:3, :3].T).as_rotvec()
        e = np.concatenate([pose.mean.T[:3, 3] - T_FIRST_SECOND[:3, 3], turned])
        found.append(float(e @ np.linalg.solve(pose.covariance, e)))
    # Of six degrees of freedom; what many images share is stated but not simulated, so the errors are smaller.
    assert 2.0 < np.mean(found) < 8.0


def bumped(noise_px: float) -> tuple[FurtherPose, Transform]:
    """A fixed camera with eight images, before the last two of which somebody moved it by 5 mm."""
    made = looking(1, 5)
    stood = made.T_world_camera[0]
    moved = stood.copy()
    moved[:3, 3] += [0.005, 0.0, 0.0]
    views = replace(made, T_world_camera=np.array([*[stood] * 6, moved, moved]))
    return fixed_pose(seen(views, noise_px, 1)), stood


def test_a_fixed_camera_that_was_moved_is_found_out() -> None:
    pose, stood = bumped(0.05)
    assert pose.mean.kept.tolist() == [True] * 6 + [False] * 2
    away_m, _ = off(pose.mean.T, stood)
    assert away_m < 3 * np.sqrt(np.trace(pose.covariance[:3, :3]))
    assert np.linalg.norm(pose.mean.deviations[-1, :3]) == pytest.approx(0.005, rel=0.2)


def test_many_images_of_a_fixed_camera_are_no_more_certain_than_one() -> None:
    made = looking(1, 5)
    many = replace(made, T_world_camera=np.repeat(made.T_world_camera, 8, axis=0))
    one, eight = (fixed_pose(seen(views, 0.1)) for views in (made, many))
    assert np.trace(eight.covariance) > 0.4 * np.trace(one.covariance)


def test_no_image_with_four_spheres_is_an_error_in_words() -> None:
    made = looking(1, 5)
    three = exact_outlines(made, 0, REGISTRATION_M[:3])[0]
    with pytest.raises(ComputeError, match="spheres"):
        sighted_pose(three, made.camera, REGISTRATION, None)
    with pytest.raises(ComputeError, match="no image"):
        fixed_pose({})
