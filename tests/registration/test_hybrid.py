"""Hybrid poses: exact data give exact poses, errors are weighted by their size, covariances are consistent."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.compute.camera_model import CameraCovariance
from service.compute.markers.cones import ObservedCones
from service.compute.scene import PosedImages
from service.compute.sfm.bundle import AdjustmentData, BundleState, Sigmas, SphereSightings, linearise, moved, width
from service.compute.sfm.estimate import similarity_covariance
from service.compute.sfm.hybrid import HybridOptions, HybridPoses, hybrid_poses
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, align_points, inverse, transform
from tests.support.scenes.sphere_images import RADIUS_M, REGISTRATION, REGISTRATION_M
from tests.support.scenes.tracked_scene import TrackedScene, pose_errors, tracked_scene

EXACT_SPHERES = HybridOptions(sphere_sigma_m=1e-6)


def noisy(
    seed: int,
    *,
    robot_m: float = 5e-4,
    robot_rad: float = 1e-3,
    points: int = 150,
    outliers: float = 0.0,
    camera_error_px: float = 0.0,
) -> TrackedScene:
    return tracked_scene(
        seed,
        points=points,
        track_px=0.3,
        outline_px=0.1,
        robot_m=robot_m,
        robot_rad=robot_rad,
        outliers=outliers,
        camera_error_px=camera_error_px,
    )


def adjust(
    made: TrackedScene,
    *,
    robot: bool = True,
    T_base_camera: Array | None = None,
    known_camera: CameraCovariance | None = None,
    options: HybridOptions = EXACT_SPHERES,
) -> HybridPoses:
    images = PosedImages(made.poses, made.camera, groups=made.groups if robot else None, metric=False)
    if robot and T_base_camera is None:
        T_base_camera = made.T_base_camera
    return hybrid_poses(
        images,
        made.tracks,
        made.outlines,
        REGISTRATION,
        T_base_camera=T_base_camera,
        known_camera=known_camera,
        options=options,
    )


@pytest.mark.parametrize("seed", [1, 2])
def test_exact_data_give_the_exact_poses_scale_and_stations(seed: int) -> None:
    made = tracked_scene(seed)
    answer = adjust(made)
    assert np.abs(pose_errors(answer.T_scan_camera, made.T_scan_camera)).max() < 2e-6
    T_world_scan = inverse(made.T_scan_base[0])
    assert np.abs(answer.T_world_scan - T_world_scan).max() < 1e-5
    assert np.abs(answer.T_world_group[1] - T_world_scan @ made.T_scan_base[1]).max() < 1e-5
    assert np.abs(answer.T_world_camera - T_world_scan @ made.T_scan_camera).max() < 1e-5


@pytest.mark.slow
def test_noise_is_estimated_and_covariances_are_honest() -> None:
    joint: list[float] = []
    scan: list[float] = []
    alone: list[float] = []
    robot: list[tuple[float, float]] = []
    for seed in range(6):
        made = noisy(seed)
        answer = adjust(made)
        error = pose_errors(answer.T_scan_camera, made.T_scan_camera)
        C = answer.covariance[: error.size, : error.size]
        joint.append(float(error.ravel() @ np.linalg.solve(C, error.ravel()) / error.size))
        placed = pose_errors(answer.T_world_scan[None], inverse(made.T_scan_base[0])[None])[0]
        scan.append(float(placed @ np.linalg.solve(answer.scan_covariance, placed) / 6))
        assert answer.sigma_track_px == pytest.approx(0.3, rel=0.2)
        assert answer.sigma_robot_m is not None
        assert answer.sigma_robot_rad is not None
        robot.append((answer.sigma_robot_m, answer.sigma_robot_rad))
        alone.append(float(np.sqrt(np.mean(error[:, :3] ** 2))))
    assert np.median(robot, axis=0) == pytest.approx([5e-4, 1e-3], rel=0.3)
    assert 0.6 < np.mean(joint) < 1.6
    assert 0.4 < np.mean(scan) < 2.0
    assert np.mean(alone) < 0.2 * 5e-4


@pytest.mark.slow
@pytest.mark.parametrize("robot", [True, pytest.param(False, marks=pytest.mark.sweep)])
def test_covariance_is_honest_with_little_texture(robot: bool) -> None:
    """Far fewer tracks than parameters: 30 points in 40 images, of which each image sees some 21."""
    ratios: list[float] = []
    for seed in range(4):
        made = tracked_scene(
            seed, images=40, points=30, track_px=0.3, outline_px=0.1, robot_m=5e-4, robot_rad=1e-3, outliers=0.02
        )
        answer = adjust(made, robot=robot)
        error = pose_errors(answer.T_scan_camera, made.T_scan_camera).ravel()
        C = answer.covariance[: error.size, : error.size]
        ratios.append(float(error @ np.linalg.solve(C, error)) / error.size)
    assert 0.7 < np.mean(ratios) < 1.4


def test_covariance_of_world_poses_follows_from_the_joint_one() -> None:
    """Moving the estimate in its parameters moves the world poses as the derivative predicts."""
    answer = adjust(noisy(3))
    rng = np.random.default_rng(0)
    n = len(answer.T_scan_camera)
    step = 1e-6 * rng.normal(size=(n + 2, 6))

    def turned(T: np.ndarray, d: np.ndarray) -> np.ndarray:
        return transform(Rotation.from_rotvec(d[3:]).as_matrix() @ T[:3, :3], T[:3, 3] + d[:3])

    base = turned(inverse(answer.T_world_scan), step[n])
    moved_world = np.array([inverse(base) @ turned(T, d) for T, d in zip(answer.T_scan_camera, step, strict=False)])
    change = pose_errors(
        np.array([*moved_world, inverse(base)]), np.array([*answer.T_world_camera, answer.T_world_scan])
    )
    only = dataclasses.replace(answer, covariance=np.outer(step.ravel(), step.ravel()))
    expected = np.outer(change.ravel(), change.ravel())
    assert np.abs(only.joint_world_covariance() - expected).max() < 1e-4 * np.abs(expected).max()


def test_false_matches_do_not_matter() -> None:
    made = noisy(4, outliers=0.1)
    error = pose_errors(adjust(made).T_scan_camera, made.T_scan_camera)
    assert np.sqrt(np.mean(error[:, :3] ** 2)) < 1.5e-4


def test_a_wrong_principal_point_is_found_with_the_calibration_as_prior() -> None:
    made = noisy(5, robot_m=1e-4, robot_rad=1e-4, points=300, camera_error_px=3.0)
    held, free = (
        adjust(made),
        adjust(made, options=dataclasses.replace(EXACT_SPHERES, lens_covariance=np.diag([4.0, 4.0, 9.0, 9.0]))),
    )
    assert held.camera == made.camera
    assert abs(free.camera.cx - (made.camera.cx - 3.0)) < 1.0
    worse, better = (pose_errors(a.T_scan_camera, made.T_scan_camera) for a in (held, free))
    assert np.sqrt(np.mean(better[:, 3:] ** 2)) < 0.5 * np.sqrt(np.mean(worse[:, 3:] ** 2))


@pytest.mark.slow
@pytest.mark.parametrize("robot", [True, pytest.param(False, marks=pytest.mark.sweep)])
def test_what_is_not_known_of_the_camera_is_in_the_uncertainty(robot: bool) -> None:
    """Cameras with errors of their calibration's covariance: without it the stated sigma is far too small."""
    names, sigmas = ("fx", "fy", "cx", "cy", "k1"), np.array([4.0, 4.0, 2.0, 2.0, 0.004])
    matrix = np.diag(sigmas**2)
    matrix[0, 1] = matrix[1, 0] = 0.98 * 16.0  # the errors of both focal lengths are correlated
    known = CameraCovariance(names, matrix)
    rng = np.random.default_rng(11)
    stated: list[Array] = []
    without: list[Array] = []
    for seed in range(5):
        off = dict(zip(names, rng.multivariate_normal(np.zeros(5), matrix), strict=True))
        made = tracked_scene(
            seed, track_px=0.3, outline_px=0.1, robot_m=5e-4, robot_rad=1e-3,
            camera_errors={name: float(d) for name, d in off.items()},
        )  # fmt: skip
        answer = adjust(made, known_camera=known, robot=robot)
        error = pose_errors(answer.T_scan_camera, made.T_scan_camera)
        for ratios, share in ((stated, 0.0), (without, answer.camera_share)):
            sigma = np.sqrt(np.diag(answer.covariance - share)[: error.size])
            ratios.append(error.ravel() / sigma)
    assert np.sqrt(np.mean(np.square(without))) > 3
    assert 0.5 < np.sqrt(np.mean(np.square(stated))) < 1.5


def test_spheres_alone_make_the_poses_metric() -> None:
    made = noisy(6)
    answer = adjust(made, robot=False)
    assert np.array_equal(answer.T_world_camera, answer.T_scan_camera)
    assert answer.sigma_robot_m is None
    assert np.sqrt(np.mean(pose_errors(answer.T_scan_camera, made.T_scan_camera)[:, :3] ** 2)) < 1.5e-4
    assert not answer.scan_covariance.any()


def test_an_image_without_a_robot_pose_is_adjusted_all_the_same() -> None:
    made = noisy(7)
    robot = made.T_base_camera.copy()
    robot[2] = np.nan
    answer = adjust(made, T_base_camera=robot)
    assert np.linalg.norm(pose_errors(answer.T_scan_camera, made.T_scan_camera)[2, :3]) < 3e-4


def test_what_cannot_be_adjusted_is_refused() -> None:
    made = tracked_scene(8)
    with pytest.raises(DataError, match="stations"):
        adjust(dataclasses.replace(made, groups=made.groups[:-1]))
    robot = made.T_base_camera.copy()
    robot[5:] = np.nan
    with pytest.raises(ComputeError, match="station 1 has 1 images"):
        adjust(made, T_base_camera=robot)


def test_derivatives_of_every_component() -> None:
    made = tracked_scene(9, points=40, track_px=0.3)
    rng = np.random.default_rng(1)
    found = [(i, o) for i, outlines in enumerate(made.outlines) for o in outlines][:6]
    data = AdjustmentData(
        tracks=made.tracks,
        sightings=SphereSightings(
            np.array([i for i, _ in found]),
            np.arange(6),
            ObservedCones.of(o.cone for _, o in found),
            rng.normal(size=(6, 3, 3)) * 1e3,
        ),
        centres=REGISTRATION_M,
        centre_whitening=rng.normal(size=(10, 3, 3)) * 1e3,
        common_sigma_px=np.full(6, 0.05),
        light_unit_m=3e-4,
        radius_m=RADIUS_M,
        robot=made.T_base_camera,
        group=made.groups,
        calibrated=made.camera,
        lens_covariance=np.diag([1.0, 2.0, 3.0, 4.0]),
    )
    # scan coordinates, slightly off so that no residual is zero
    X = np.vstack([np.column_stack([rng.uniform(-0.2, 0.2, (len(made.tracks.points), 2)),
                                    rng.uniform(0, 0.1, len(made.tracks.points))]), REGISTRATION_M])  # fmt: skip
    state = BundleState(
        made.T_scan_camera, X + rng.normal(0, 1e-3, X.shape), made.T_scan_base, made.camera, rng.normal(size=6)
    )
    frame, points = rng.normal(0, 1e-6, width(state, data)), rng.normal(0, 1e-6, X.shape)
    ahead, behind = (linearise(moved(state, data, k * frame, k * points), data, Sigmas()) for k in (1, -1))
    for name, rows in linearise(state, data, Sigmas()).items():
        numeric = (ahead[name].residual - behind[name].residual) / 2
        analytic = rows.frame @ frame + rows.point @ points.ravel()
        assert np.abs(numeric - analytic).max() < 2e-3 * np.abs(numeric).max(), name


@pytest.mark.slow
def test_covariance_of_structure_from_motion_is_honest() -> None:
    ratios: list[float] = []
    for seed in range(6):
        made = tracked_scene(20 + seed, track_px=0.3, outline_px=1.0)
        answer = adjust(made, robot=False)  # converged poses, metric
        points = answer.points_scan
        C = similarity_covariance(answer.T_scan_camera, dataclasses.replace(made.tracks, points=points), made.camera)
        T, s = align_points(answer.T_scan_camera[:, :3, 3], made.T_scan_camera[:, :3, 3], with_scale=True)
        truth = np.array([T @ transform(P[:3, :3], s * P[:3, 3]) for P in made.T_scan_camera])
        error = pose_errors(answer.T_scan_camera, truth).ravel()
        values, vectors = np.linalg.eigh(C)
        along = vectors[:, 7:].T @ error
        ratios.append(float(np.mean(along**2 / values[7:])))
        assert values[6] < 1e-8 * values[7]  # seven degrees of freedom are undetermined
    assert 0.6 < np.mean(ratios) < 1.6
