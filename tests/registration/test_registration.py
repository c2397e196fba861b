"""The registration solver: exact outlines give exact poses, derivatives are right, sigmas are consistent."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from service.compute.markers.cones import ObservedCones, cone_of_sphere
from service.compute.markers.records import SphereOutline
from service.compute.registration.identity import Assignment
from service.compute.registration.problem import (
    Cost,
    PointCost,
    RegistrationSettings,
    residuals,
    residuals_and_derivative,
)
from service.compute.registration.result import RegistrationResult
from service.compute.registration.solve import register
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import ComputeError
from service.core.geometry import Transform, apply, inverse, rotation_angle_rad, transform
from tests.support.scenes.sphere_images import RADIUS_M, REGISTRATION_M, Scene, exact_outlines, false_outlines, scene


def perturbed(T: Transform, seed: int, size: float = 1.0) -> Transform:
    rng = np.random.default_rng(seed)
    return transform(Rotation.from_rotvec(rng.normal(size=3) * 0.02 * size), rng.normal(size=3) * 0.004 * size) @ T


def problem(
    made: Scene, noise_px: float = 0.0, seed: int = 0
) -> tuple[list[tuple[SphereOutline, ...]], list[Assignment]]:
    outlines: list[tuple[SphereOutline, ...]] = []
    assignments: list[Assignment] = []
    for i, T in enumerate(made.T_world_camera):
        found, ids = exact_outlines(made, i, REGISTRATION_M, noise_px, seed)
        outlines.append(found)
        assignments.append(Assignment(dict(enumerate(ids)), perturbed(inverse(T) @ made.T_world_scan, seed + i)))
    return outlines, assignments


def solve(
    made: Scene,
    outlines: Sequence[Sequence[SphereOutline]],
    assignments: Sequence[Assignment],
    cost: Cost = "cone",
) -> RegistrationResult:
    return register(
        outlines,
        assignments,
        PosedImages(made.T_world_camera, made.camera),
        ScanSpheres(REGISTRATION_M, RADIUS_M),
        RegistrationSettings(cost=cost),
    )


@given(st.integers(0, 100_000), st.sampled_from(["sampson", "algebraic"]))
def test_derivative_equals_numerical_differences(seed: int, cost: PointCost) -> None:
    rng = np.random.default_rng(seed)
    centres = np.array([rng.uniform(-0.2, 0.2), rng.uniform(-0.15, 0.15), rng.uniform(0.4, 1.0)]) * np.ones((5, 1))
    points = centres / centres[:, 2:]
    points[:, :2] += rng.normal(size=(5, 2)) * 0.02
    _, D = residuals_and_derivative(points, centres, RADIUS_M, cost)
    for j in range(3):
        h = np.zeros(3)
        h[j] = 1e-6
        numeric = (
            residuals(points, centres + h, RADIUS_M, cost) - residuals(points, centres - h, RADIUS_M, cost)
        ) / 2e-6
        assert np.allclose(D[:, j], numeric, rtol=1e-4, atol=1e-6 * np.abs(D).max() + 1e-9)


@given(st.integers(0, 100_000))
def test_derivative_of_a_cone_equals_numerical_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    centres = np.column_stack([rng.uniform(-0.2, 0.2, 5), rng.uniform(-0.15, 0.15, 5), rng.uniform(0.4, 1.0, 5)])
    across = ObservedCones.of(cone_of_sphere(c + rng.normal(size=3) * 1e-3, RADIUS_M) for c in centres)
    for cones in (across, ObservedCones.with_chords(across.axes, across.half_angles)):
        _, D = cones.residuals(centres, RADIUS_M)
        for j in range(3):
            h = np.zeros(3)
            h[j] = 1e-6
            more, less = (cones.residuals(centres + s * h, RADIUS_M)[0] for s in (1, -1))
            assert np.allclose(D[:, :, j], (more - less) / 2e-6, rtol=1e-5, atol=1e-6)


@given(st.integers(0, 100_000))
def test_sampson_is_the_distance_in_the_image(seed: int) -> None:
    rng = np.random.default_rng(seed)
    made = scene(1, seed=seed % 50)
    c = np.array([rng.uniform(-0.2, 0.2), rng.uniform(-0.1, 0.1), 0.65])
    cone = cone_of_sphere(c, RADIUS_M)
    delta = rng.uniform(-3, 3) / made.camera.fx
    azimuth = rng.uniform(0, 6.28, 4)
    rays = cone.rays(azimuth, np.full(4, cone.half_angle_rad + delta))
    edge = cone.rays(azimuth, np.full(4, cone.half_angle_rad))
    points, on = rays / rays[:, 2:], edge / edge[:, 2:]
    distance = np.linalg.norm(points - on, axis=1)
    value = residuals(points, np.tile(c, (4, 1)), RADIUS_M, "sampson")
    assert np.allclose(np.abs(value), distance, rtol=0.08)
    assert np.all(np.sign(value) == np.sign(delta)) or abs(delta) < 1e-9


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(["cone", "sampson", "algebraic"]))
def test_exact_outlines_give_the_exact_pose(seed: int, cost: Cost) -> None:
    made = scene(4, seed=seed)
    result = solve(made, *problem(made, seed=seed), cost=cost)
    assert np.linalg.norm(result.T_world_scan[:3, 3] - made.T_world_scan[:3, 3]) < 1e-7
    assert rotation_angle_rad(inverse(result.T_world_scan) @ made.T_world_scan) < 1e-6
    assert result.rms_px < 1e-4
    assert not result.excluded


@settings(max_examples=6, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.02, 50.0))
def test_scale_is_solved_jointly(seed: int, scale: float) -> None:
    made = scene(5, seed=seed)
    outlines, assignments = problem(made, seed=seed)
    poses = np.array(made.T_world_camera)
    poses[:, :3, 3] /= scale
    start = [Assignment(a.markers, a.T_camera_scan, scale * 1.01) for a in assignments]
    result = register(
        outlines, start, PosedImages(poses, made.camera, metric=False), ScanSpheres(REGISTRATION_M, RADIUS_M)
    )
    assert result.scale == pytest.approx(scale, rel=1e-6)
    assert result.covariance.shape == (7, 7)
    assert np.allclose(result.T_world_scan, made.T_world_scan, atol=1e-6)


@settings(max_examples=6, deadline=None)
@given(st.integers(0, 10_000))
def test_stations_are_joined_through_the_spheres(seed: int) -> None:
    made = scene(6, seed=seed)
    outlines, assignments = problem(made, seed=seed)
    rng = np.random.default_rng(seed)
    T_world_second = transform(Rotation.random(rng=rng), rng.uniform(-1, 1, 3))
    poses = np.array(made.T_world_camera)
    poses[3:] = inverse(T_world_second) @ poses[3:]
    result = register(
        outlines,
        assignments,
        PosedImages(poses, made.camera, groups=[1, 1, 1, 2, 2, 2]),
        ScanSpheres(REGISTRATION_M, RADIUS_M),
    )
    assert np.allclose(result.T_world_scan, made.T_world_scan, atol=1e-6)
    assert np.allclose(result.T_world_group[1], np.eye(4), atol=1e-12)
    assert np.allclose(result.T_world_group[2], T_world_second, atol=1e-6)
    truth = inverse(made.T_world_scan) @ made.T_world_camera
    assert np.allclose(result.T_scan_camera, truth, atol=1e-6)


def test_a_wrong_outline_is_excluded_and_named() -> None:
    made = scene(5, seed=2)
    outlines, assignments = problem(made, 0.05, 2)
    stranger = false_outlines(made.camera, 1, 4)
    outlines[1] = outlines[1] + stranger
    taken = set(assignments[1].markers.values())
    free = next(m for m in range(10) if m not in taken) if len(taken) < 10 else 0
    markers = {**assignments[1].markers, len(outlines[1]) - 1: free}
    assignments[1] = Assignment(markers, assignments[1].T_camera_scan)
    result = solve(made, outlines, assignments)
    assert [(r.image, r.outline) for r in result.excluded] == [(1, len(outlines[1]) - 1)]
    assert "px" in result.excluded[0].reason
    assert np.linalg.norm(apply(result.T_world_scan, np.zeros(3)) - made.T_world_scan[:3, 3]) < 3e-4


def test_two_markers_are_refused() -> None:
    made = scene(3, seed=1)
    outlines, assignments = problem(made)
    few = [Assignment({d: m for d, m in a.markers.items() if m < 2}, a.T_camera_scan) for a in assignments]
    with pytest.raises(ComputeError, match="do not determine"):
        solve(made, outlines, few)


def test_a_station_that_keeps_two_markers_once_false_outlines_are_left_out_is_refused() -> None:
    """Two markers leave the station's base free to turn about the line through them."""
    made = scene(7, seed=0)
    outlines, assignments = problem(made, 0.1)
    for i in (5, 6):
        right = {d: m for d, m in assignments[i].markers.items() if m in (2, 3)}
        outlines[i] += false_outlines(made.camera, 2, seed=i)
        false = {len(outlines[i]) - 2: 0, len(outlines[i]) - 1: 1}
        assignments[i] = Assignment(right | false, assignments[i].T_camera_scan)
    with pytest.raises(ComputeError, match=r"station 2 has only . markers whose outlines agree with one another"):
        register(
            outlines,
            assignments,
            PosedImages(made.T_world_camera, made.camera, groups=[1, 1, 1, 1, 1, 2, 2]),
            ScanSpheres(REGISTRATION_M, RADIUS_M),
        )


@pytest.mark.parametrize("cost", ["sampson", "algebraic"])
def test_every_cost_weighs_the_outlines_against_the_errors_of_the_poses(cost: Cost) -> None:
    """The answers differ by less than their stated error, though the costs have different units."""
    made = scene(6, seed=0)
    outlines, assignments = problem(made, 0.1)
    rng = np.random.default_rng(0)
    off = [transform(Rotation.from_rotvec(rng.normal(size=3) * 1e-3), rng.normal(size=3) * 5e-4) for _ in range(6)]
    moved = Scene(made.T_world_scan, made.T_world_camera @ np.array(off), made.camera)
    cone, other = (solve(moved, outlines, assignments, each) for each in ("cone", cost))
    e = (other.T_world_scan - cone.T_world_scan)[:3, 3]
    assert e @ np.linalg.solve(cone.covariance[:3, :3], e) < 1.0
    sigma_m, _ = cone.pose_sigma
    assert np.abs(other.T_scan_camera_refined - cone.T_scan_camera_refined)[:, :3, 3].max() < sigma_m


def test_where_the_poses_tell_nothing_the_refined_covariance_does_not_depend_on_them() -> None:
    made = scene(5, seed=0)
    outlines, assignments = problem(made, 0.1)
    sigmas: list[np.ndarray] = []
    for size in (0.0, 2.0):  # up to 2 cm and 5 degrees
        poses = np.array([perturbed(T, 100 * i, size) for i, T in enumerate(made.T_world_camera)])
        result = register(
            outlines,
            assignments,
            PosedImages(poses, made.camera),
            ScanSpheres(REGISTRATION_M, RADIUS_M),
            RegistrationSettings(pose_covariance="free"),
        )
        R = result.T_world_scan[:3, :3]
        in_scan = R.T @ result.refined_covariance[:3, :3] @ R / result.outline_factor
        sigmas.append(np.sqrt(np.diag(in_scan)))
    assert np.allclose(sigmas[0], sigmas[1], rtol=0.05)
