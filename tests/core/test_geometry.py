"""Transforms, their derivatives, and the best rigid motion between points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from service.core.geometry import (
    align_points,
    apply,
    from_quaternion,
    from_rotation_vector,
    increment,
    inverse,
    look_at,
    place_jacobian,
    rotation_angle_rad,
    skew,
    to_rotation_vector,
    transform,
)

POINTS_M = np.array([[0.3, -0.1, 0.2], [-0.2, 0.4, 0.1], [0.05, 0.15, -0.35], [0.25, 0.3, 0.1], [-0.1, -0.2, 0.4]])
T = transform(Rotation.from_rotvec([0.4, -0.9, 0.3]), np.array([0.5, -0.2, 0.7]))


def test_the_cross_product_matrix_is_that_of_the_cross_product() -> None:
    assert np.allclose(skew(POINTS_M) @ [0.1, -0.7, 0.2], np.cross(POINTS_M, [0.1, -0.7, 0.2]))


@pytest.mark.parametrize("k", range(6))
def test_the_derivative_by_a_pose_equals_numerical_differences(k: int) -> None:
    """Signs included: a turn about an axis moves points as `increment` does, not the other way."""
    step = np.zeros(6)
    step[k] = 1e-6
    ahead, behind = (apply(increment(T, s * step[:3], s * step[3:]), POINTS_M) for s in (1, -1))
    derivative = place_jacobian(POINTS_M @ T[:3, :3].T)
    assert derivative.shape == (len(POINTS_M), 3, 6)
    assert np.allclose(derivative[:, :, k], (ahead - behind) / 2e-6, atol=1e-8)


def test_an_increment_turns_about_the_moved_frames_own_origin_in_the_axes_of_the_outer_one() -> None:
    turned = increment(T, np.array([0.0, 0.0, 0.1]), np.array([0.0, 0.0, np.pi / 2]))
    assert np.allclose(turned[:3, 3], [0.5, -0.2, 0.8])
    assert np.allclose(turned[:3, :3] @ T[:3, :3].T @ [1, 0, 0], [0, 1, 0])


@given(st.tuples(*[st.floats(-3, 3)] * 3))
@settings(max_examples=30, deadline=None)
def test_the_best_motion_is_found_and_is_a_rotation(turn: tuple[float, ...]) -> None:
    moved = apply(transform(Rotation.from_rotvec(turn), np.array([1.0, -2.0, 0.5])), POINTS_M)
    T_a_b, scale = align_points(moved, POINTS_M)
    assert scale == 1.0
    assert np.allclose(apply(T_a_b, POINTS_M), moved)
    assert np.isclose(np.linalg.det(T_a_b[:3, :3]), 1.0)
    T_a_b, scale = align_points(moved, POINTS_M / 2.5, with_scale=True)
    assert np.isclose(scale, 2.5)
    assert np.allclose(apply(T_a_b, scale * POINTS_M / 2.5), moved)


def test_a_mirrored_constellation_is_not_aligned_by_a_mirror() -> None:
    """An axis negated by a program on the way leaves residuals of centimetres, and is no rotation."""
    for axis in range(3):
        mirror = np.where(np.arange(3) == axis, -1.0, 1.0)
        for with_scale in (False, True):
            T_a_b, scale = align_points(POINTS_M * mirror, POINTS_M, with_scale=with_scale)
            assert np.isclose(np.linalg.det(T_a_b[:3, :3]), 1.0)
            misfit_m = np.linalg.norm(apply(T_a_b, scale * POINTS_M) - POINTS_M * mirror, axis=1)
            assert misfit_m.max() > 0.05
            assert scale <= 1.0


def test_rotation_vectors_and_quaternions_come_back() -> None:
    for turn in ([0.0, 0.0, 0.0], [3e-4, -2e-4, 5e-4], [0.3, 2.0, -1.1], [0.0, 3.1, 0.0]):
        pose = np.array([0.1, 0.2, 0.3, *turn])
        assert np.allclose(from_rotation_vector(pose)[:3, :3], Rotation.from_rotvec(turn).as_matrix(), atol=1e-14)
        assert np.allclose(to_rotation_vector(from_rotation_vector(pose)), pose, atol=1e-12)
        of_quaternion = from_quaternion(pose[:3], Rotation.from_rotvec(turn).as_quat())
        assert np.allclose(of_quaternion, from_rotation_vector(pose), atol=1e-14)
    assert np.isnan(from_rotation_vector(np.array([0.0, 0.0, 0.0, np.inf, 0.0, 0.0]))[:3, :3]).all()


def test_inverse_and_angle() -> None:
    assert np.allclose(inverse(T) @ T, np.eye(4))
    assert np.isclose(rotation_angle_rad(T), np.linalg.norm([0.4, -0.9, 0.3]))


def test_a_camera_looks_at_its_target_with_the_top_up() -> None:
    eye, target = np.array([1.0, 2.0, 0.5]), np.array([0.0, 0.5, 0.0])
    T_world_camera = look_at(eye, target, np.array([0.0, 0.0, 1.0]))
    seen = apply(inverse(T_world_camera), target)
    assert np.allclose(seen, [0, 0, float(np.linalg.norm(target - eye))])
    assert np.isclose(np.linalg.det(T_world_camera[:3, :3]), 1.0)
    above = apply(inverse(T_world_camera), target + np.array([0, 0, 0.1]))
    assert above[1] < -0.05  # y is down
    assert np.isclose(above[0], 0.0)
