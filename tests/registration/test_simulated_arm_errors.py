"""The stated errors of poses also hold for an arm whose errors are systematic: geometry as built, and gears."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.compute.registration.identity import Assignment
from service.compute.registration.problem import CommonErrors, RegistrationSettings
from service.compute.registration.result import RegistrationResult, camera_errors
from service.compute.registration.solve import register
from service.compute.scene import PosedImages, ScanSpheres
from service.core.geometry import Array, apply, inverse, look_at, transform
from simulators.scene.world import Scene as Laboratory
from tests.support.scenes.sphere_images import Scene, camera, exact_outlines

SCENES, AT_EACH_STATION = 4, 15
SPHERE_SIGMA_M = 2e-5
COMMON = CommonErrors(shift_px=1e-5, growth_px=1e-5, light_px=1e-5)


def poses_of(laboratory: Laboratory, station: str, rng: np.random.Generator) -> list[tuple[Array, Array]]:
    """The true T_world_camera and the arm's T_base_camera, of views from all sides that the arm reaches."""
    T_world_base, T_flange_camera = laboratory.T_world_base[station], laboratory.T_flange_camera
    from_base = -T_world_base[:2, 3] / np.linalg.norm(T_world_base[:2, 3])
    found: list[tuple[Array, Array]] = []
    while len(found) < AT_EACH_STATION:
        azimuth, tilt, distance = rng.uniform((0.0, 0.14, 0.45), (2 * np.pi, 0.73, 0.60))
        side = np.sin(tilt) * np.array([np.cos(azimuth), np.sin(azimuth)])
        middle = np.array([0.0, 0.0, 0.05])
        eye = middle + distance * np.array([*side, np.cos(tilt)])
        T_world_camera = look_at(eye, middle + rng.uniform(-0.03, 0.03, 3), np.array([*from_base, 0.0]))
        q = laboratory.arm.joints_for(inverse(T_world_base) @ T_world_camera @ inverse(T_flange_camera))
        if q is not None:
            found.append((laboratory.true_camera(q, station), laboratory.nominal_flange(q) @ T_flange_camera))
    return found


def registered(seed: int) -> tuple[RegistrationResult, Array]:
    """A registration with the poses that the simulated arm reports, and the true T_scan_camera (N, 4, 4)."""
    laboratory, rng = Laboratory.generate(seed), np.random.default_rng(seed)
    at_stations = [poses_of(laboratory, station, rng) for station in laboratory.T_world_base]
    true, given = (np.array([pair[k] for poses in at_stations for pair in poses]) for k in (0, 1))
    T_world_scan = transform(Rotation.random(rng=rng), rng.uniform(-0.3, 0.3, 3))
    wide = dataclasses.replace(camera(), fx=1500.0, fy=1500.0)
    made, spheres_m = Scene(T_world_scan, true, wide), apply(inverse(T_world_scan), laboratory.registration_m)
    found = [exact_outlines(made, i, spheres_m, 0.1, seed) for i in range(len(true))]
    result = register(
        [outlines for outlines, _ in found],
        [
            Assignment(dict(enumerate(order)), inverse(T) @ T_world_scan)
            for (_, order), T in zip(found, true, strict=True)
        ],
        PosedImages(given, wide, groups=[k for k, poses in enumerate(at_stations) for _ in poses]),
        ScanSpheres(
            spheres_m + rng.normal(size=spheres_m.shape) * SPHERE_SIGMA_M,
            laboratory.radius_m,
            covariance_m2=np.tile(SPHERE_SIGMA_M**2 * np.eye(3), (len(spheres_m), 1, 1)),
        ),
        RegistrationSettings(common_errors=COMMON),
    )
    return result, inverse(T_world_scan) @ true


def squared(T: Array, true: Array, covariance: Array) -> float:
    """Squared error of a pose in the metric of its covariance, per degree of freedom."""
    w = Rotation.from_matrix(true[:3, :3] @ T[:3, :3].T).as_rotvec()
    e = np.concatenate([true[:3, 3] - T[:3, 3], w])
    return float(e @ np.linalg.solve(covariance, e)) / 6


@pytest.mark.slow
def test_poses_of_a_simulated_arm_are_as_wrong_as_stated() -> None:
    known = [registered(seed) for seed in range(1, SCENES + 1)]
    for refined in (False, True):
        found: list[float] = []
        for result, true in known:
            joint = camera_errors(result, refined=refined)
            poses = result.T_scan_camera_refined if refined else result.T_scan_camera
            found.extend(
                squared(T, T_true, joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6])
                for k, (T, T_true) in enumerate(zip(poses, true, strict=True))
            )
        assert 0.7 < np.mean(found) < 1.4, f"refined: {refined}"
        assert np.mean(np.array(found) < 3) > 0.9  # of a chi-square of six degrees of freedom, 0.6 % are beyond
