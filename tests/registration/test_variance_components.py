"""The noise of outlines and poses, estimated from residuals that were drawn with known noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from service.compute.registration.problem import (
    Blocks,
    compress,
    inverse_symmetric,
    marginalise,
    outline_and_pose_shares,
    pose_errors,
    solve_symmetric,
)
from service.compute.registration.solve import (
    PoseNoise,
    estimate,
    free_poses,
    given_pose_noise,
    no_pose_noise,
    unknown_pose_noise,
)
from service.core.geometry import Array

UNKNOWNS, IMAGES, OUTLINES = 6, 12, 8  # outlines an image
STATED = np.tile(np.diag([1e-8, 1e-8, 1e-8, 4e-8, 4e-8, 4e-8]), (IMAGES, 1, 1))  # 0.1 mm, 0.2 mrad


@dataclass(frozen=True, slots=True)
class Drawn:
    """Whitened rows with known noise: of outlines of unit variance times `factor`, of poses of some covariance."""

    J: Array  # (O, 3, n)
    A: Array  # (O, 3, 6)
    r: Array  # (O, 3)
    image: NDArray[np.int64]  # (O,)

    def blocks(self, weights: Array | None = None) -> Blocks:
        whole = np.ones(len(self.image)) if weights is None else weights
        return compress(self.J, self.A, self.r, self.image, IMAGES, whole)


def drawn(seed: int, *, factor: float = 1.0, pose_growth: float = 0.0) -> Drawn:
    """Rows of 12 images; errors of poses are `pose_growth` times those stated."""
    rng = np.random.default_rng(seed)
    image = np.repeat(np.arange(IMAGES, dtype=np.int64), OUTLINES)
    rng.shuffle(image)
    n = len(image)
    J, A = rng.normal(size=(n, 3, UNKNOWNS)), rng.normal(size=(n, 3, 6)) * 3e4
    xi = pose_growth * rng.normal(size=(IMAGES, 6)) * np.sqrt(np.diagonal(STATED, axis1=1, axis2=2))
    r = np.sqrt(factor) * rng.normal(size=(n, 3)) - np.einsum("okj,oj->ok", A, xi[image])
    return Drawn(J, A, r + J @ (rng.normal(size=UNKNOWNS) * 0.1), image)


NO_PRIOR = np.zeros((UNKNOWNS, UNKNOWNS))


def estimated(blocks: Blocks, noise: PoseNoise, factor: float = 1.0, start: float = 1.0) -> tuple[float, Array]:
    return estimate(blocks, noise, NO_PRIOR, np.zeros(UNKNOWNS), (factor, np.full(len(noise.parts), start)))


@pytest.mark.parametrize(("factor", "growth"), [(1.0, 1.0), (4.0, 1.0), (1.0, 3.0), (0.25, 2.0)])
def test_the_noise_that_was_drawn_is_found(factor: float, growth: float) -> None:
    found = [estimated(drawn(seed, factor=factor, pose_growth=growth).blocks(), given_pose_noise(STATED))
             for seed in range(6)]  # fmt: skip
    assert np.mean([f for f, _ in found]) == pytest.approx(factor, rel=0.15)
    assert np.mean([scales[0] for _, scales in found]) == pytest.approx(growth, rel=0.15)


def test_stated_covariances_of_poses_grow_and_never_shrink() -> None:
    """Residuals that happen to be small are no proof that an arm is better than its certificate."""
    for seed in range(3):
        _, scales = estimated(drawn(seed).blocks(), given_pose_noise(STATED))
        assert scales[0] == pytest.approx(1.0, rel=1e-12)


def test_unknown_noise_of_poses_shrinks_and_grows_in_position_and_orientation_alone() -> None:
    noise = unknown_pose_noise(IMAGES)
    _, none = estimated(drawn(1).blocks(), noise)
    assert np.all(none < 0.1)
    _, stated = estimated(drawn(2, pose_growth=1.0).blocks(), noise)
    assert stated == pytest.approx([1.0, 2.0], rel=0.35)  # in units of 0.1 mm and 0.1 mrad


def test_the_noise_of_poses_grows_at_most_fivefold_at_a_time() -> None:
    blocks = drawn(3, pose_growth=200.0).blocks()
    noise, start = given_pose_noise(STATED), 1.0
    for _ in range(3):
        _, scales = estimated(blocks, noise, start=start)
        assert scales[0] == pytest.approx(5 * start, rel=1e-9)
        start = float(scales[0])
    _, scales = estimated(blocks, noise, start=start)
    assert scales[0] == pytest.approx(200.0, rel=0.3)


def test_a_wide_prior_holds_the_noise_of_outlines_that_few_residuals_tell() -> None:
    """One residual more than unknowns, and zero: without the prior the variance would fall to the least allowed."""
    rng = np.random.default_rng(0)
    J, A = rng.normal(size=(3, 3, 8)), np.zeros((3, 3, 6))
    blocks = compress(J, A, np.zeros((3, 3)), np.zeros(3, dtype=np.int64), 1, np.ones(3))
    factor, scales = estimate(blocks, no_pose_noise(1), np.zeros((8, 8)), np.zeros(8), (1.0, np.ones(1)))
    # The cost of y, the logarithm of the square root, is 2 y (9 - 8) + y²: its least value is at -1.
    assert factor == pytest.approx(np.exp(-2.0), rel=1e-4)
    assert scales == pytest.approx([1.0])


def test_poses_that_are_not_free_keep_their_noise() -> None:
    blocks = drawn(4, pose_growth=3.0).blocks()
    for noise in (no_pose_noise(IMAGES), free_poses(IMAGES)):
        _, scales = estimated(blocks, noise, start=0.7)
        assert scales == pytest.approx([0.7])
    assert np.allclose(free_poses(2).root(np.ones(1)), 0.1 * np.eye(6))
    assert not no_pose_noise(2).root(np.ones(1)).any()
    root = given_pose_noise(STATED).root(np.array([2.0]))
    assert np.allclose(root @ root.transpose(0, 2, 1), 4 * STATED, atol=1e-20)


def test_what_is_known_beforehand_counts_as_an_observation() -> None:
    """A prior of the unknowns, and where they stand, enter the likelihood as rows do."""
    rows = drawn(5, factor=2.0)
    known = np.diag(np.linspace(50.0, 90.0, UNKNOWNS))
    held = np.linspace(-0.3, 0.3, UNKNOWNS)
    factor, _ = estimate(rows.blocks(), no_pose_noise(IMAGES), known, known @ held, (1.0, np.ones(1)))
    J, r = rows.J.reshape(-1, UNKNOWNS), rows.r.ravel()

    def cost(y: float) -> float:
        of_rows = np.exp(2 * y)
        R = of_rows * np.eye(len(r)) + J @ np.linalg.inv(known) @ J.T
        off = r - J @ held
        return float(off @ np.linalg.solve(R, off) + np.linalg.slogdet(R)[1] + y**2)

    best = minimize_scalar(cost, bounds=(-0.5, 1.0), method="bounded").x
    assert 0.5 * np.log(factor) == pytest.approx(best, abs=1e-4)


# --- the normal equations, against the dense ones --------------------------------------------------------


def dense(rows: Drawn, root: Array, factor: float, weights: Array) -> tuple[Array, Array, Array, Array]:
    """J (R, n), r (R,), the covariance (R, R) of all rows, and A (R, 6 N), weighted and in order of the outlines."""
    w = np.sqrt(np.repeat(weights, 3))
    J, r = rows.J.reshape(-1, UNKNOWNS) * w[:, None], rows.r.ravel() * w
    A = np.zeros((len(r), 6 * IMAGES))
    for o, i in enumerate(rows.image):
        A[3 * o : 3 * o + 3, 6 * i : 6 * i + 6] = rows.A[o] * np.sqrt(weights[o])
    P = np.zeros((6 * IMAGES, 6 * IMAGES))
    for i in range(IMAGES):
        P[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = root[i] @ root[i].T
    return J, r, factor * np.eye(len(r)) + A @ P @ A.T, A @ P


def test_marginal_normal_equations_equal_the_dense_ones() -> None:
    rows = drawn(6, factor=2.0, pose_growth=2.0)
    root = given_pose_noise(STATED).root(np.array([1.7]))
    weights = np.random.default_rng(6).uniform(0.2, 1.0, len(rows.image))
    blocks, factor = rows.blocks(weights), 1.9
    m = marginalise(blocks, root, factor)
    J, r, R, AP = dense(rows, root, factor, weights)
    inverse = np.linalg.inv(R)
    assert np.allclose(m.H, J.T @ inverse @ J, rtol=1e-8)
    assert np.allclose(m.g, J.T @ inverse @ r, rtol=1e-7, atol=1e-7)
    assert m.quadratic == pytest.approx(float(r @ inverse @ r), rel=1e-9)
    counted = 3 * float(np.sum(weights))  # an outline of less weight counts as less than three rows
    assert m.log_determinant == pytest.approx(
        float(np.linalg.slogdet(R)[1]) + (counted - len(r)) * np.log(factor), rel=1e-9
    )
    dx = -solve_symmetric(m.H, m.g)
    assert np.allclose(m.H @ dx, -m.g, atol=1e-9 * np.abs(m.g).max())
    assert np.allclose(inverse_symmetric(m.H) @ m.H, np.eye(UNKNOWNS), atol=1e-9)
    # The most probable errors of the poses, given all rows.
    xi = -(AP.T @ inverse @ (r + J @ dx)).reshape(IMAGES, 6)
    assert np.allclose(pose_errors(blocks, m, dx, factor), xi, rtol=1e-6, atol=1e-12)
    outlines, poses = outline_and_pose_shares(blocks, m, root, factor)
    share = J.T @ inverse @ (R - factor * np.eye(len(r))) @ inverse @ J
    assert np.allclose(poses, share, rtol=1e-6, atol=1e-6)
    assert np.allclose(outlines + poses, m.H, rtol=1e-9)


def test_units_of_the_unknowns_do_not_matter_and_an_unknown_without_information_gets_no_step() -> None:
    scale = np.diag([1.0, 1e-9, 1e6])
    bare = np.array([[2.0, 0.3, 0.1], [0.3, 1.0, 0.2], [0.1, 0.2, 3.0]])
    H = scale @ bare @ scale
    b = H @ np.array([1.0, 2e9, 3e-6])
    assert np.allclose(solve_symmetric(H, b), [1.0, 2e9, 3e-6], rtol=1e-9)
    assert np.allclose(scale @ inverse_symmetric(H) @ scale, np.linalg.inv(bare))
    flat = np.diag([4.0, 0.0])
    assert np.allclose(solve_symmetric(flat, np.array([8.0, 0.0])), [2.0, 0.0])
    assert np.allclose(inverse_symmetric(flat), np.diag([0.25, 0.0]))


def test_what_rounding_leaves_of_a_difference_is_not_taken_for_information() -> None:
    """Only the sum of two unknowns is determined; with a little more, their difference is as well."""
    by_rounding, determined = (np.array([[1.0, 1.0 - rest], [1.0 - rest, 1.0]]) for rest in (8e-15, 1e-12))
    assert np.allclose(inverse_symmetric(by_rounding), 0.25, rtol=1e-6)
    assert np.allclose(solve_symmetric(by_rounding, np.array([2.0, 0.0])), 0.5, rtol=1e-6)
    assert inverse_symmetric(determined)[0, 0] == pytest.approx(5e11, rel=0.01)
    assert solve_symmetric(determined, np.array([2.0, 0.0]))[0] == pytest.approx(1e12, rel=0.01)
