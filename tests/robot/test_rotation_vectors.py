"""Poses of Universal Robots controllers as transforms: the same as SciPy's, also for no rotation and lost numbers."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from service.core.geometry import from_rotation_vector


def test_a_rotation_vector_gives_the_matrix_that_scipy_gives() -> None:
    rng = np.random.default_rng(4)
    for size in (0.0, 1e-12, 1e-6, 0.999e-3, 1.001e-3, 0.1, 1.0, math.pi, 2 * math.pi, 40.0):
        for _ in range(50):
            turn = rng.normal(size=3)
            turn *= size / np.linalg.norm(turn)
            T = from_rotation_vector(np.array([0.3, -0.2, 0.9, *turn]))
            np.testing.assert_allclose(T[:3, :3], Rotation.from_rotvec(turn).as_matrix(), rtol=0, atol=1e-15)
            np.testing.assert_array_equal(T[:3, 3], [0.3, -0.2, 0.9])
            np.testing.assert_array_equal(T[3], [0.0, 0.0, 0.0, 1.0])


def test_a_rotation_vector_that_is_no_number_gives_none_and_raises_nothing() -> None:
    for bad in (math.nan, math.inf, -math.inf, 1e300):
        T = from_rotation_vector(np.array([0.3, -0.2, 0.9, 0.0, bad, 0.0]))
        assert np.all(np.isnan(T[:3, :3]))
        np.testing.assert_array_equal(T[:3, 3], [0.3, -0.2, 0.9])
