"""The stated covariances of the registration are consistent, whatever the source of the errors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.compute.registration.identity import Assignment, identify
from service.compute.registration.problem import CommonErrors, RegistrationSettings
from service.compute.registration.result import RegistrationResult
from service.compute.registration.solve import register
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import DataError
from service.core.geometry import Array, apply, inverse, skew, transform
from tests.support.scenes.sphere_images import RADIUS_M, REGISTRATION_M, Scene, exact_outlines, scene
from tests.support.scenes.tracked_scene import tracked_scene
from tests.support.stated_errors import sigma_components_m

NOTHING_COMMON = CommonErrors(shift_px=1e-5, growth_px=1e-5, light_px=1e-5)
TARGET = np.array([0.02, -0.01, 0.05])
NOISE_PX = 0.1


def solved(
    made: Scene, seed: int, *, pose_sigma: tuple[float, float] = (0.0, 0.0), sphere_sigma_m: float = 0.0
) -> RegistrationResult:
    """A registration with errors of these sizes, all known to the solver except those of the poses."""
    rng = np.random.default_rng([seed, 77])
    n = len(made.T_world_camera)
    found = [exact_outlines(made, i, REGISTRATION_M, NOISE_PX, seed) for i in range(n)]
    poses = made.T_world_camera.copy()
    for i in range(n):
        poses[i, :3, :3] = Rotation.from_rotvec(rng.normal(size=3) * pose_sigma[1]).as_matrix() @ poses[i, :3, :3]
        poses[i, :3, 3] += rng.normal(size=3) * pose_sigma[0]
    spheres = REGISTRATION_M + rng.normal(size=REGISTRATION_M.shape) * sphere_sigma_m
    assignments = [
        Assignment(dict(enumerate(f[1])), inverse(T) @ made.T_world_scan) for f, T in zip(found, poses, strict=True)
    ]
    return register(
        [f[0] for f in found],
        assignments,
        PosedImages(poses, made.camera),
        ScanSpheres(
            spheres,
            RADIUS_M,
            covariance_m2=np.tile(np.eye(3) * sphere_sigma_m**2, (10, 1, 1)) if sphere_sigma_m else None,
        ),
        RegistrationSettings(
            pose_covariance="estimate" if any(pose_sigma) else "exact", common_errors=NOTHING_COMMON
        ),
    )


def chi2(result: RegistrationResult, made: Scene) -> float:
    """Squared error of T_world_scan (six numbers) in the metric of the stated covariance, per degree of freedom."""
    e = apply(result.T_world_scan, TARGET) - apply(made.T_world_scan, TARGET)
    w = Rotation.from_matrix(made.T_world_scan[:3, :3] @ result.T_world_scan[:3, :3].T).as_rotvec()
    both = np.concatenate([made.T_world_scan[:3, 3] - result.T_world_scan[:3, 3], w])
    sigma = result.sigma_at_m(TARGET)
    assert np.linalg.norm(e) < 4 * sigma
    return float(both @ np.linalg.solve(result.covariance, both)) / 6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pose_sigma", "sphere_sigma_m", "main"),
    [
        ((0.0, 0.0), 0.0, "outlines"),
        pytest.param((2e-4, 2e-4), 0.0, "poses", marks=pytest.mark.sweep),
        pytest.param((0.0, 0.0), 5e-5, "spheres", marks=pytest.mark.sweep),
    ],
)
def test_errors_have_the_size_stated(pose_sigma: tuple[float, float], sphere_sigma_m: float, main: str) -> None:
    made = scene(6, seed=9)
    values: list[float] = []
    for seed in range(20):
        result = solved(made, seed, pose_sigma=pose_sigma, sphere_sigma_m=sphere_sigma_m)
        values.append(chi2(result, made))
        assert 0.4 < result.chi2_reduced < 2.0
        parts = sigma_components_m(result, TARGET)
        assert max(parts, key=lambda k: parts[k]) == main
        assert sum(v**2 for v in parts.values()) == pytest.approx(result.sigma_at_m(TARGET) ** 2, rel=1e-3)
    assert 0.6 < np.mean(values) < 1.6


def test_errors_of_poses_are_taken_off() -> None:
    """Poses as bad as those of an uncalibrated arm do less harm if their errors are marginalised."""
    made = scene(8, seed=4)
    truth = inverse(made.T_world_scan) @ made.T_world_camera
    before: list[float] = []
    after: list[float] = []
    for seed in range(4):
        result = solved(made, seed, pose_sigma=(5e-4, 5e-4))
        assert result.pose_sigma[0] == pytest.approx(5e-4, rel=0.6) or result.pose_sigma[1] == pytest.approx(
            5e-4, rel=0.6
        )
        for out, cameras in ((before, result.T_scan_camera), (after, result.T_scan_camera_refined)):
            # where each camera sees the target, compared with the truth
            seen = apply_each(cameras, truth, TARGET)
            out.append(float(np.mean(seen)))
    assert np.mean(after) < 0.3 * np.mean(before)


def apply_each(cameras: Array, truth: Array, point: Array) -> Array:
    """Distances (N,) between estimated and true position of a point in each camera."""
    return np.array(
        [
            float(np.linalg.norm(apply(inverse(a), point) - apply(inverse(b), point)))
            for a, b in zip(cameras, truth, strict=True)
        ]
    )


def test_map_equals_the_value_at_points() -> None:
    made = scene(5, seed=2)
    result = solved(made, 1)
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (50, 3))
    values = result.sigma_map_m(points)
    for p, v in zip(points[:5], values, strict=False):
        assert v == pytest.approx(float(np.sqrt(np.trace(result.covariance_at_m2(p)))), rel=1e-9)
        assert v == pytest.approx(result.sigma_at_m(p))
    far = np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1))
    assert values[far] > values.min()


def test_what_no_view_can_tell_remains() -> None:
    """A displacement shared by all outlines stays in the predicted error, however many images there are."""
    made = scene(6, seed=3)
    n = len(made.T_world_camera)
    found = [exact_outlines(made, i, REGISTRATION_M, 0.01, 0) for i in range(n)]
    assignments = [Assignment(dict(enumerate(f[1])), inverse(T) @ made.T_world_scan)
                   for f, T in zip(found, made.T_world_camera, strict=True)]  # fmt: skip
    result = register(
        [f[0] for f in found],
        assignments,
        PosedImages(made.T_world_camera, made.camera),
        ScanSpheres(REGISTRATION_M, RADIUS_M),
        RegistrationSettings(common_errors=CommonErrors(shift_px=1e-5, growth_px=1e-5, light_px=0.1)),
    )
    seen = np.concatenate([made.centres_camera(i, REGISTRATION_M) for i in range(n)])
    distance = float(np.mean(np.linalg.norm(seen, axis=1)))
    expected = np.sqrt(3) * 0.1 / made.camera.fx * distance
    assert sigma_components_m(result, TARGET)["common"] == pytest.approx(expected, rel=0.1)


def test_covariances_of_the_wrong_shape_are_refused() -> None:
    made = scene(4, seed=1)
    found = [exact_outlines(made, i, REGISTRATION_M) for i in range(4)]
    assignments = [Assignment(dict(enumerate(f[1])), inverse(T) @ made.T_world_scan)
                   for f, T in zip(found, made.T_world_camera, strict=True)]  # fmt: skip
    with pytest.raises(DataError, match="shape"):
        register(
            [f[0] for f in found],
            assignments,
            PosedImages(made.T_world_camera, made.camera),
            ScanSpheres(REGISTRATION_M, RADIUS_M),
            RegistrationSettings(pose_covariance=np.zeros((3, 6, 6))),
        )


def test_a_turned_frame_changes_nothing() -> None:
    """The prediction is a property of the point and does not depend on the frames."""
    made = scene(5, seed=6)
    turned = transform(Rotation.from_rotvec([0.3, -1.0, 0.4]), np.array([0.5, -0.2, 1.0]))
    other = Scene(turned @ made.T_world_scan, turned @ made.T_world_camera, made.camera)
    a, b = (solved(m, 0, pose_sigma=(1e-9, 1e-9)) for m in (made, other))
    assert a.sigma_at_m(TARGET) == pytest.approx(b.sigma_at_m(TARGET), rel=0.05)


@pytest.mark.slow
def test_refined_cameras_are_placed_as_well_as_stated() -> None:
    """The scan relative to the cameras, with the arm's errors removed."""
    made = scene(8, seed=4)
    truth = inverse(made.T_world_scan) @ made.T_world_camera
    squares: list[float] = []
    for seed in range(12):
        result = solved(made, seed, pose_sigma=(4e-4, 4e-4), sphere_sigma_m=2e-5)
        moved = [apply(a @ inverse(b), TARGET) - TARGET
                 for a, b in zip(result.T_scan_camera_refined, truth, strict=True)]  # fmt: skip
        turned = result.T_world_scan[:3, :3] @ TARGET
        J = np.hstack([np.eye(3), -skew(turned)])
        C = J @ result.refined_covariance @ J.T
        error = result.T_world_scan[:3, :3] @ np.mean(moved, axis=0)
        squares.append(float(error @ np.linalg.solve(C, error)) / 3)
        assert np.trace(C) < 0.2 * result.sigma_at_m(TARGET) ** 2
        assert np.sum(list(result.refined_components().values()), axis=0) == pytest.approx(result.refined_covariance)
    assert 0.4 < np.mean(squares) < 2.2


@pytest.mark.parametrize("with_scale", [True, False])
@pytest.mark.parametrize("seed", [1, 6, 8])
def test_exact_outlines_and_poses_of_another_unit(seed: int, with_scale: bool) -> None:
    """Residuals hundreds of times the stated outline errors come from the poses; the scale may be needed first."""
    made = tracked_scene(seed)
    found = identify(
        made.outlines, PosedImages(made.poses, made.camera, metric=False), ScanSpheres(REGISTRATION_M, RADIUS_M)
    )
    assignments = [Assignment(a.markers, a.T_camera_scan, a.scale if with_scale else None) for a in found]
    result = register(
        made.outlines,
        assignments,
        PosedImages(made.poses, made.camera, metric=False),
        ScanSpheres(REGISTRATION_M, RADIUS_M),
    )
    assert result.scale == pytest.approx(made.scale, rel=1e-3)
    assert result.pose_sigma[0] < 1e-3
    assert not result.excluded
