"""Poses with correlated errors: the stated covariance of the registration takes them into account."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.compute.registration.identity import Assignment
from service.compute.registration.result import RegistrationResult, with_joint_pose_covariance
from service.compute.registration.solve import register
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import DataError
from service.core.geometry import apply
from tests.support.scenes.sphere_images import RADIUS_M, REGISTRATION_M, exact_outlines, scene

N = 8
CENTRE = REGISTRATION_M.mean(axis=0)


def registered(seed: int, errors: np.ndarray) -> tuple[RegistrationResult, np.ndarray]:
    """A registration with poses off by `errors` (N, 6), and the displacement (3,) of the centre."""
    made = scene(N, seed=3)
    poses = made.T_world_camera.copy()
    poses[:, :3, :3] = Rotation.from_rotvec(errors[:, 3:]).as_matrix() @ poses[:, :3, :3]
    poses[:, :3, 3] += errors[:, :3]
    seen = [exact_outlines(made, i, REGISTRATION_M, noise_px=0.03, seed=seed) for i in range(N)]
    T_camera_scan = [np.linalg.inv(T) @ made.T_world_scan for T in made.T_world_camera]
    known = [Assignment(dict(enumerate(which)), T) for (_, which), T in zip(seen, T_camera_scan, strict=True)]
    answer = register(
        [o for o, _ in seen], known, PosedImages(poses, made.camera), ScanSpheres(REGISTRATION_M, RADIUS_M)
    )
    return answer, apply(answer.T_world_scan, CENTRE) - apply(made.T_world_scan, CENTRE)


@pytest.mark.slow
def test_errors_that_all_images_share_are_stated_in_full() -> None:
    # Half of each pose's error is common to all images, like a tilted frame; half is its own.
    sigma = np.array([0.05e-3] * 3 + [0.05e-3] * 3)
    joint = np.kron(np.ones((N, N)), np.diag(sigma**2)) + np.kron(np.eye(N), np.diag((0.3 * sigma) ** 2))
    root = np.linalg.cholesky(joint)
    independent: list[float] = []
    together: list[float] = []
    for seed in range(12):
        errors = (root @ np.random.default_rng(seed).normal(size=6 * N)).reshape(N, 6)
        answer, off = registered(seed, errors)
        stated = with_joint_pose_covariance(answer, joint)
        independent.append(float(off @ off) / answer.sigma_at_m(CENTRE) ** 2)
        together.append(float(off @ off) / stated.sigma_at_m(CENTRE) ** 2)
        parts = np.sum(list(stated.components.values()), axis=0)
        np.testing.assert_allclose(stated.covariance, parts)
    assert 0.5 < np.mean(together) < 2.0
    assert np.mean(independent) > 2 * np.mean(together)


def test_a_covariance_of_other_images_is_refused() -> None:
    answer, _ = registered(0, np.zeros((N, 6)))
    with pytest.raises(DataError, match="joint covariance"):
        with_joint_pose_covariance(answer, np.eye(6 * N + 6))
