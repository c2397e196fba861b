"""The robust mean of poses: it finds the truth within its own covariance, in any frame, and among false poses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from service.compute.registration.further_camera import RigidMean, rigid_mean
from service.compute.registration.result import of_inverse, of_product
from service.core.errors import DataError
from service.core.geometry import Array, Transform, increment, inverse, rotation_angle_rad, transform

SEEDS = st.integers(0, 1_000_000)


def some_pose(rng: np.random.Generator) -> Transform:
    return transform(Rotation.random(rng=rng), rng.uniform(-1.0, 1.0, 3))


def some_covariance(rng: np.random.Generator) -> Array:
    """Of a tenth of a millimetre and a tenth of a milliradian, with correlations."""
    A = rng.normal(size=(6, 6)) + 2 * np.eye(6)
    return (1e-4 / 3) ** 2 * A @ A.T


def drawn(truth: Transform, covariances: Array, rng: np.random.Generator, factor: float = 1.0) -> Array:
    """Poses with errors of these covariances."""
    errors = [factor * rng.multivariate_normal(np.zeros(6), C, method="cholesky") for C in covariances]
    return np.array([increment(truth, e[:3], e[3:]) for e in errors])


def deviation(mean: Transform, truth: Transform) -> Array:
    turned = Rotation.from_matrix(mean[:3, :3] @ truth[:3, :3].T).as_rotvec()
    return np.concatenate([mean[:3, 3] - truth[:3, 3], turned])


def chi2(found: RigidMean, truth: Transform) -> float:
    e = deviation(found.T, truth)
    return float(e @ np.linalg.solve(found.covariance, e))


@pytest.mark.slow
def test_the_error_is_as_large_as_the_covariance_says() -> None:
    rng = np.random.default_rng(1)
    found: list[float] = []
    for _ in range(200):
        truth, covariances = some_pose(rng), np.array([some_covariance(rng) for _ in range(12)])
        found.append(chi2(rigid_mean(drawn(truth, covariances, rng), covariances), truth))
    # The mean of 200 chi-squared values of six degrees of freedom has a sigma of 0.25.
    assert 5.0 < np.mean(found) < 7.0


@pytest.mark.slow
@given(SEEDS, st.floats(2.0, 6.0))
@settings(max_examples=30, deadline=None)
def test_poses_that_scatter_more_than_stated_widen_the_covariance(seed: int, factor: float) -> None:
    rng = np.random.default_rng(seed)
    truth, covariances = some_pose(rng), np.array([some_covariance(rng) for _ in range(20)])
    stated = rigid_mean(drawn(truth, covariances, rng), covariances)
    wider = rigid_mean(drawn(truth, covariances, rng, factor), covariances)
    assert wider.chi2_reduced > 0.4 * factor**2
    assert np.trace(wider.covariance) > np.trace(stated.covariance)
    assert chi2(wider, truth) < 40.0


@given(SEEDS, st.integers(1, 4))
@settings(max_examples=40, deadline=None)
def test_false_poses_are_left_out(seed: int, false: int) -> None:
    rng = np.random.default_rng(seed)
    truth, covariances = some_pose(rng), np.array([some_covariance(rng) for _ in range(12)])
    poses = drawn(truth, covariances, rng)
    for k in range(false):
        poses[k] = increment(truth, np.array([0.01, 0.0, 0.02 * k]), np.array([0.0, 0.02, 0.01]))
    found = rigid_mean(poses, covariances)
    assert not found.kept[:false].any()
    assert found.kept.sum() >= 12 - false - 1
    assert chi2(found, truth) < 40.0


@pytest.mark.parametrize("seed", range(8))
def test_false_poses_that_agree_with_one_another_do_not_win_over_more_true_ones(seed: int) -> None:
    """Four of eleven are wrong by the same, thirty times their error: as after a blow to a camera."""
    rng = np.random.default_rng([seed, 1])
    truth, covariances = some_pose(rng), np.tile(1e-8 * np.eye(6), (11, 1, 1))
    poses = drawn(truth, covariances, rng, factor=4.0)
    blow = 3e-3 * np.array([1.0, -1.0, 0.5, 0.5, 1.0, -0.5])
    poses[:4] = [increment(pose, blow[:3], blow[3:]) for pose in poses[:4]]
    found = rigid_mean(poses, covariances)
    assert not found.kept[:4].any()
    assert np.linalg.norm(deviation(found.T, truth)) < 1.5e-3


@pytest.mark.slow
@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_the_mean_moves_with_the_frame(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth, covariances = some_pose(rng), np.array([some_covariance(rng) for _ in range(8)])
    poses, T_c_a = drawn(truth, covariances, rng), some_pose(rng)
    here = rigid_mean(poses, covariances)
    moved = np.array([of_product(T_c_a, T, np.zeros((6, 6)), C) for T, C in zip(poses, covariances, strict=True)])
    there = rigid_mean(T_c_a @ poses, moved)
    assert np.allclose(there.T, T_c_a @ here.T, atol=1e-9)
    assert np.allclose(there.covariance, of_product(T_c_a, here.T, np.zeros((6, 6)), here.covariance), rtol=1e-5)
    assert there.chi2_reduced == pytest.approx(here.chi2_reduced, rel=1e-5)


def test_one_pose_is_its_own_mean() -> None:
    rng = np.random.default_rng(3)
    truth, C = some_pose(rng), some_covariance(rng)
    found = rigid_mean(truth[None], C[None])
    assert np.allclose(found.T, truth)
    assert np.allclose(found.covariance, C)
    assert found.rms_m == pytest.approx(0.0, abs=1e-12)


def test_poses_that_all_contradict_one_another_say_so() -> None:
    rng = np.random.default_rng(4)
    C, first = some_covariance(rng), some_pose(rng)
    poses = [increment(first, rng.normal(size=3) * 0.05, rng.normal(size=3) * 0.05) for _ in range(6)]
    found = rigid_mean(np.array(poses), np.repeat(C[None], 6, axis=0))
    assert found.rms_m > 0.02
    assert found.chi2_reduced > 1000
    assert np.trace(found.covariance[:3, :3]) > 0.005**2


@given(SEEDS)
@settings(max_examples=40, deadline=None)
def test_covariances_of_inverses_and_products_follow_the_poses(seed: int) -> None:
    """Each column of the Jacobian, by moving the pose a little."""
    rng = np.random.default_rng(seed)
    T_a_b, T_b_c, C, D = some_pose(rng), some_pose(rng), some_covariance(rng), some_covariance(rng)
    steps = 1e-6 * np.eye(6)
    by_inverse = [deviation(inverse(increment(T_a_b, s[:3], s[3:])), inverse(T_a_b)) / 1e-6 for s in steps]
    by_first = [deviation(increment(T_a_b, s[:3], s[3:]) @ T_b_c, T_a_b @ T_b_c) / 1e-6 for s in steps]
    by_second = [deviation(T_a_b @ increment(T_b_c, s[:3], s[3:]), T_a_b @ T_b_c) / 1e-6 for s in steps]
    J, K, L = (np.array(columns).T for columns in (by_inverse, by_first, by_second))
    assert np.allclose(of_inverse(T_a_b, C), J @ C @ J.T, rtol=1e-3, atol=1e-3 * np.abs(C).max())
    assert np.allclose(
        of_product(T_a_b, T_b_c, C, D), K @ C @ K.T + L @ D @ L.T, rtol=1e-3, atol=1e-3 * np.abs(C).max()
    )
    assert rotation_angle_rad(T_a_b @ inverse(T_a_b)) < 1e-7


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize(("chi2_of_one", "kept"), [(16.0, True), (32.0, False)])
def test_one_pose_is_left_out_if_its_distance_is_rarer_than_one_in_a_thousand(
    axis: int, chi2_of_one: float, kept: bool
) -> None:
    """The others agree exactly, so it is the stated covariances alone that say how far is too far."""
    sigma = np.array([1e-4, 2e-4, 3e-4, 1e-3, 2e-3, 3e-3])
    error = np.where(np.arange(6) == axis, np.sqrt(chi2_of_one) * sigma, 0.0)
    truth = some_pose(np.random.default_rng(7))
    poses = np.array([truth] * 20 + [increment(truth, error[:3], error[3:])])
    found = rigid_mean(poses, np.array([np.diag(sigma**2)] * 21))
    assert found.kept.tolist() == [True] * 20 + [kept]
    expected = error / 21 if kept else np.zeros(6)
    assert np.allclose(deviation(found.T, truth), expected, atol=1e-3 * sigma.min())
    assert np.allclose(found.covariance, np.diag(sigma**2) / (21 if kept else 20))  # it never states less than given
    spread = np.linalg.norm(error) * np.sqrt(20) / 21 if kept else 0.0
    assert np.allclose((found.rms_m, found.rms_rad), (spread, 0.0) if axis < 3 else (0.0, spread), atol=1e-9)


def test_a_single_pose_is_its_own_mean_and_none_has_no_mean() -> None:
    rng = np.random.default_rng(8)
    pose, covariance = some_pose(rng), some_covariance(rng)
    found = rigid_mean(pose[None], covariance[None])
    assert np.allclose(found.T, pose)
    assert np.allclose(found.covariance, covariance)
    assert (found.chi2_reduced, found.kept.tolist()) == (1.0, [True])
    for poses, covariances in ((pose[None][:0], covariance[None][:0]), (pose[None], covariance[None][:0])):
        with pytest.raises(DataError, match="poses and"):
            rigid_mean(poses, covariances)
