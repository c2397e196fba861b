"""Without a CT: successive images refine spheres and cameras, compared with ground truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from service.compute.hand_held import AdjustedCapture, ImageReading, adjust_together
from service.core.geometry import Array, Transform, align_points, apply, inverse, look_at, rotation_angle_rad
from tests.support.runs.measuring_rig import SPHERES_M
from tests.support.scenes.sphere_images import Scene, camera, exact_outlines

CAMERA = camera(1200)
RADIUS_M = 0.015
MIDDLE_M = SPHERES_M.mean(axis=0)


def around(tilt_deg: float, azimuth_deg: float) -> Transform:
    """A camera 0.7 m from the centre, in the world frame."""
    tilt, azimuth = np.radians([tilt_deg, azimuth_deg])
    way = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])
    return look_at(MIDDLE_M + 0.7 * way, MIDDLE_M, np.array([0.0, 1.0, 0.0]))


POSES = [around(5, 0), around(30, 0), around(30, 100), around(30, 200), around(35, 300), around(15, 50)]
ROUGH_M = SPHERES_M + np.random.default_rng(3).normal(0.0, 0.002, SPHERES_M.shape)


def readings(noise_px: float = 0.15) -> list[ImageReading]:
    """Readings of images whose cameras are known to a centimetre and a degree, as from rough spheres."""
    rng = np.random.default_rng(8)
    made = Scene(np.eye(4), np.array(POSES), CAMERA)
    found: list[ImageReading] = []
    for image, T in enumerate(POSES):
        outlines, spheres = exact_outlines(made, image, SPHERES_M, noise_px, margin_px=30)
        off = T.copy()
        off[:3, 3] += rng.normal(0.0, 0.004, 3)
        found.append(ImageReading.of(f"h_{image}", off, dict(zip(spheres, outlines, strict=True))))
    return found


def spheres_error_m(bundle: AdjustedCapture) -> float:
    """Largest sphere error, of the shape alone."""
    true, found = SPHERES_M[bundle.known], bundle.spheres_m[bundle.known]
    T, _ = align_points(true, found)
    return float(np.linalg.norm(apply(T, found) - true, axis=1).max())


def poses_error_m(bundle: AdjustedCapture) -> float:
    """Largest distance between true and estimated camera, after aligning the scenes."""
    T, _ = align_points(SPHERES_M[bundle.known], bundle.spheres_m[bundle.known])
    return max(
        float(np.linalg.norm((T @ bundle.poses[f"h_{i}"])[:3, 3] - true[:3, 3]))
        for i, true in enumerate(POSES)
        if f"h_{i}" in bundle.poses
    )


def bundle_of(count: int) -> AdjustedCapture:
    found = adjust_together(readings()[:count], ROUGH_M, CAMERA, RADIUS_M)
    assert found is not None
    return found


def test_images_refine_what_they_begin_with() -> None:
    worst = np.linalg.norm(ROUGH_M - SPHERES_M, axis=1).max()
    errors = {count: spheres_error_m(bundle_of(count)) for count in (2, 4, 6)}
    assert errors[6] < errors[2] < worst / 2
    assert errors[6] < 3e-4
    assert poses_error_m(bundle_of(6)) < 2e-3


def test_the_stated_uncertainty_is_that_of_the_errors() -> None:
    for count in (2, 4, 6):
        bundle = bundle_of(count)
        assert spheres_error_m(bundle) < 3 * bundle.sigma_m
    assert bundle_of(6).sigma_m < bundle_of(2).sigma_m < 0.002


def test_outlines_that_are_all_too_wide_are_within_the_stated_uncertainty() -> None:
    wide_rad = 0.03 / CAMERA.fx  # in pixels: light that shines past every edge
    grown = [replace(r, half_angles_rad=r.half_angles_rad + wide_rad) for r in readings(0.0)]
    bundle = adjust_together(grown, ROUGH_M, CAMERA, RADIUS_M)
    assert bundle is not None
    assert bundle.sigma_m / 2 < spheres_error_m(bundle) < 2 * bundle.sigma_m


def test_the_frame_stays_where_it_was() -> None:
    bundle = bundle_of(6)
    moved, _ = align_points(ROUGH_M, bundle.spheres_m)
    assert np.linalg.norm(moved[:3, 3]) < 1e-6
    assert rotation_angle_rad(moved) < 1e-6
    apart = inverse(POSES[2]) @ bundle.poses["h_2"]
    assert np.linalg.norm(apart[:3, 3]) < 0.01


def test_what_is_recorded_is_read_again() -> None:
    for reading in readings():
        again = ImageReading.read(reading.viewpoint, reading.T_scene_camera, reading.record())
        np.testing.assert_array_equal(again.axes, reading.axes)
        np.testing.assert_array_equal(again.spheres, reading.spheres)
        np.testing.assert_array_equal(again.covariances, reading.covariances)


def test_one_image_alone_changes_nothing() -> None:
    assert adjust_together(readings()[:1], ROUGH_M, CAMERA, RADIUS_M) is None


@pytest.mark.parametrize("spheres", [SPHERES_M[::-1], SPHERES_M[:0]])
def test_images_that_do_not_fit_together_change_nothing(spheres: Array) -> None:
    wrong = [
        ImageReading(r.viewpoint, r.T_scene_camera, np.roll(r.spheres, i), r.axes, r.half_angles_rad, r.covariances)
        for i, r in enumerate(readings())
    ]
    assert adjust_together(wrong if len(spheres) else [], spheres, CAMERA, RADIUS_M) is None
