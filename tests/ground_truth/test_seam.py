"""The measure of a step at the seam: it finds a step in noise, takes no slope for one, and states its error."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from service.core.geometry import Array
from tests.support.scenes.seam import Steps, no_seam, seam, steps, strips

WITHIN_M, BLEND_M, STEP_M = 3e-3, 3e-3, 1e-4
X_M, Y_M = (
    a.ravel() for a in np.meshgrid(np.arange(-0.012, 0.012, 3e-4), np.arange(-0.02, 0.02, 3e-4), indexing="ij")
)
POINTS = np.stack([X_M, Y_M, 0.02 + 0.3 * X_M], axis=1)
NORMALS = np.broadcast_to(np.array([-0.3, 0.0, 1.0]) / np.hypot(0.3, 1.0), POINTS.shape)
WEIGHT = np.clip(0.5 + X_M / BLEND_M, 0.0, 1.0)


def noise(sigma_m: float, seed: int = 3) -> Array:
    """Vertices share theirs with about three others, as those that lie on one face of a scan do."""
    rng = np.random.default_rng(seed)
    faces = rng.uniform(POINTS.min(axis=0), POINTS.max(axis=0), (len(POINTS) // 4, 3))
    faces[:, 2] = 0.02 + 0.3 * faces[:, 0]
    return rng.normal(0, sigma_m, len(faces))[cKDTree(faces).query(POINTS)[1]]


def measured(height: Array) -> Steps:
    return steps(POINTS, NORMALS, height, seam(POINTS, WEIGHT, WITHIN_M), WITHIN_M)


def test_a_step_is_found_and_proven_in_noise() -> None:
    found = measured(noise(2e-5) + STEP_M * (X_M > 0))
    assert np.mean(found.step_m) == pytest.approx(STEP_M, rel=0.1)
    assert found.told()["most_proven"] > 0.05
    on_line = strips(POINTS, np.where(X_M > 0, STEP_M, 0.0), seam(POINTS, WEIGHT, WITHIN_M), 2e-3)
    assert on_line["median"] == pytest.approx(1e3 * STEP_M, rel=0.05)


def test_a_slope_is_no_step_even_if_it_changes_at_the_seam() -> None:
    found = measured(np.where(X_M > 0, 0.05, -0.02) * X_M + 0.01 * Y_M)
    assert np.max(np.abs(found.step_m)) < 0.05 * STEP_M


@pytest.mark.slow
def test_the_standard_error_is_that_of_noise_which_neighbours_share() -> None:
    found = [measured(noise(3e-5, seed)) for seed in range(4)]
    spread = np.std(np.concatenate([one.step_m / one.error_m for one in found]))
    assert 0.75 < spread < 1.35
    beside = no_seam(POINTS, WEIGHT, WITHIN_M)
    assert np.all(X_M[beside.vertices] > BLEND_M)
