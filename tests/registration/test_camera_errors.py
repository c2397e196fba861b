"""The stated errors of an arm's poses in the scan are as large as their errors against the truth."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.compute.matching.pairs import relative_covariance, relative_pose
from service.compute.registration.identity import Assignment
from service.compute.registration.problem import CommonErrors, RegistrationSettings
from service.compute.registration.result import RegistrationResult, camera_errors
from service.compute.registration.solve import register
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import DataError
from service.core.geometry import Array, Transform, inverse, transform
from tests.support.scenes.sphere_images import RADIUS_M, REGISTRATION_M, Scene, exact_outlines, scene

SIGMA_M, SIGMA_RAD = 3e-4, 2e-4  # of the arm's poses, along each axis
SPHERE_SIGMA_M = 2e-5
IMAGES, SEEDS = 12, 8
COMMON = CommonErrors(shift_px=1e-5, growth_px=1e-5, light_px=1e-5)


def registered(made: Scene, seed: int, own_light_px: float = 0.0) -> RegistrationResult:
    """A registration of an arm's poses at two stations, whose bases are turned by a half.

    Light displaces each sphere alike in all images.
    """
    rng = np.random.default_rng([seed, 14])
    groups = [int(k >= IMAGES // 2) for k in range(IMAGES)]
    T_base_world = [np.eye(4), transform(Rotation.from_rotvec([0.1, 0.0, np.pi]), np.array([1.1, 0.2, -0.1]))]
    true = np.array([T_base_world[g] @ T for g, T in zip(groups, made.T_world_camera, strict=True)])
    poses = true.copy()
    for T in poses:
        T[:3, :3] = Rotation.from_rotvec(rng.normal(size=3) * SIGMA_RAD).as_matrix() @ T[:3, :3]
        T[:3, 3] += rng.normal(size=3) * SIGMA_M
    unit_m = float(np.mean([made.centres_camera(i, REGISTRATION_M)[:, 2] for i in range(IMAGES)])) / made.camera.fx
    seen_m = REGISTRATION_M + np.random.default_rng([seed, 15]).normal(size=(10, 3)) * own_light_px * unit_m
    found = [exact_outlines(made, i, seen_m, 0.1, seed) for i in range(IMAGES)]
    T_base_scan = [T_base_world[g] @ made.T_world_scan for g in groups]
    assignments = [
        Assignment(dict(enumerate(f[1])), inverse(T) @ T_scan)
        for f, T, T_scan in zip(found, poses, T_base_scan, strict=True)
    ]
    centres = REGISTRATION_M + rng.normal(size=REGISTRATION_M.shape) * SPHERE_SIGMA_M
    covariance_m2 = np.tile(np.eye(3) * SPHERE_SIGMA_M**2, (len(centres), 1, 1))
    return register(
        [f[0] for f in found],
        assignments,
        PosedImages(poses, made.camera, groups=groups),
        ScanSpheres(centres, RADIUS_M, covariance_m2=covariance_m2),
        RegistrationSettings(common_errors=dataclasses.replace(COMMON, own_light_px=own_light_px)),
    )


@dataclass(frozen=True)
class Known:
    """A registration, and the true poses (N, 4, 4) of its cameras in the scan."""

    result: RegistrationResult
    true: Array

    def poses(self, *, refined: bool) -> Array:
        return self.result.T_scan_camera_refined if refined else self.result.T_scan_camera


@pytest.fixture(scope="module")
def known() -> list[Known]:
    scenes = [wide(scene(IMAGES, seed=seed)) for seed in range(SEEDS)]
    return [
        Known(registered(made, seed), inverse(made.T_world_scan) @ made.T_world_camera)
        for seed, made in enumerate(scenes)
    ]


def wide(made: Scene) -> Scene:
    """The scene with a lens that shows nearly all spheres in each image."""
    camera = made.camera
    lens = dataclasses.replace(camera, fx=0.6 * camera.fx, fy=0.6 * camera.fy)
    return dataclasses.replace(made, camera=lens)


def error(T: Transform, true: Transform) -> Array:
    """(d, w) from a pose to the true one."""
    w = Rotation.from_matrix(true[:3, :3] @ T[:3, :3].T).as_rotvec()
    return np.concatenate([true[:3, 3] - T[:3, 3], w])


def squared(e: Array, covariance: Array) -> float:
    """Squared error in the metric of its covariance, per degree of freedom."""
    return float(e @ np.linalg.solve(covariance, e)) / len(e)


@pytest.mark.parametrize("refined", [False, True])
def test_poses_are_as_wrong_as_stated(known: list[Known], refined: bool) -> None:
    of_single, of_all, of_pairs = list[float](), list[float](), list[float]()
    for one in known:
        joint, poses, true = camera_errors(one.result, refined=refined), one.poses(refined=refined), one.true
        each = [error(T, T_true) for T, T_true in zip(poses, true, strict=True)]
        of_all.append(squared(np.concatenate(each), joint))
        for k, e in enumerate(each):
            block = slice(6 * k, 6 * k + 6)
            of_single.append(squared(e, joint[block, block]))
            first, second = k, (k + 1) % IMAGES
            rows = np.concatenate([np.arange(6 * i, 6 * i + 6) for i in (first, second)])
            stated = relative_covariance(poses[first], poses[second], joint[np.ix_(rows, rows)])
            off = error(relative_pose(poses[first], poses[second]), relative_pose(true[first], true[second]))
            of_pairs.append(squared(off, stated))
    # 96 poses of 6 numbers each: the mean scatters by 0.06, and more for single poses, whose errors are correlated.
    assert 0.75 < np.mean(of_all) < 1.3
    assert 0.75 < np.mean(of_single) < 1.3
    assert 0.75 < np.mean(of_pairs) < 1.3


@pytest.mark.slow
def test_light_on_single_spheres_is_in_what_is_stated_of_refined_poses() -> None:
    """Views from all sides see a sphere where it is not: no residual tells, and the cameras are tilted with it."""
    aware, unaware = list[float](), list[float]()
    for seed in range(SEEDS):
        made = wide(scene(IMAGES, seed=seed))
        result, true = registered(made, seed, own_light_px=0.3), inverse(made.T_world_scan) @ made.T_world_camera
        dark = dataclasses.replace(result.solution.problem, own_light_m=0.0)
        without = dataclasses.replace(result, solution=dataclasses.replace(result.solution, problem=dark))
        each = [error(T, T_true) for T, T_true in zip(result.T_scan_camera_refined, true, strict=True)]
        for one, squares in ((result, aware), (without, unaware)):
            joint = camera_errors(one, refined=True)
            squares += [squared(e, joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]) for k, e in enumerate(each)]
        parts = result.refined_components()
        assert np.trace(parts["spheres"]) > 2 * np.trace(without.refined_components()["spheres"])
        assert np.sum(list(result.components.values()), axis=0) == pytest.approx(result.covariance, rel=1e-6)
    assert np.mean(unaware) > 2
    assert 0.5 < np.mean(aware) < 1.5


def test_a_given_pose_errs_about_as_the_arm_and_a_refined_one_less(known: list[Known]) -> None:
    of_arm = np.array([SIGMA_M**2] * 3 + [SIGMA_RAD**2] * 3)
    for one in known:
        assert one.result.pose_sigma == pytest.approx((SIGMA_M, SIGMA_RAD), rel=0.6)
    given, refined = (
        np.mean([np.diag(camera_errors(one.result, refined=each)).reshape(-1, 6) for one in known], axis=(0, 1))
        for each in (False, True)
    )
    assert given == pytest.approx(of_arm, rel=0.5)
    assert refined[:3].sum() < 0.3 * given[:3].sum()
    assert refined[3:].sum() < 0.8 * given[3:].sum()


def test_poses_of_another_unit_are_refused(known: list[Known]) -> None:
    solution = known[0].result.solution
    problem = dataclasses.replace(solution.problem, with_scale=True)
    scaled = dataclasses.replace(known[0].result, solution=dataclasses.replace(solution, problem=problem))
    with pytest.raises(DataError, match="metric"):
        camera_errors(scaled, refined=False)
