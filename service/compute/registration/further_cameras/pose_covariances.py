"""Covariances of inverted and composed poses. Each is (6, 6) of (d, w): exp([w]x) R, t + d, m and rad."""

from __future__ import annotations

import numpy as np

from service.core.geometry import Array, Transform, skew


def of_inverse(T_a_b: Transform, covariance: Array) -> Array:
    """Covariance of T_b_a (6, 6) from that of T_a_b: with R and t of T_a_b, d' = -R^T (d + t x w), w' = -R^T w."""
    R, t = T_a_b[:3, :3], T_a_b[:3, 3]
    J = np.zeros((6, 6))
    J[:3, :3], J[3:, 3:] = -R.T, -R.T
    J[:3, 3:] = -R.T @ skew(t)
    return J @ covariance @ J.T


def of_product(T_a_b: Transform, T_b_c: Transform, covariance_a_b: Array, covariance_b_c: Array) -> Array:
    """Covariance of T_a_c (6, 6) from those of its two independent factors."""
    by_a_b, by_b_c = product_jacobians(T_a_b, T_b_c)
    return by_a_b @ covariance_a_b @ by_a_b.T + by_b_c @ covariance_b_c @ by_b_c.T


def product_jacobians(T_a_b: Transform, T_b_c: Transform) -> tuple[Array, Array]:
    """Derivatives (6, 6) of T_a_c by T_a_b and by T_b_c."""
    R = T_a_b[:3, :3]
    moved, turned = np.eye(6), np.zeros((6, 6))
    moved[:3, 3:] = -skew(R @ T_b_c[:3, 3])
    turned[:3, :3], turned[3:, 3:] = R, R
    return moved, turned
