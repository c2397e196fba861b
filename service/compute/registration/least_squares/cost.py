"""Residuals of an outline's points against a projected sphere: the paper's x^T E x, or Sampson's distance.

The cost "cone" is that of the outline's cone (`markers.observed_cones`).
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from service.core.geometry import Array

PointCost = Literal["sampson", "algebraic"]
Cost = Literal["cone", "sampson", "algebraic"]


def residuals(points: Array, centres_camera_m: Array, radius_m: float, cost: PointCost) -> Array:
    """Signed residuals (N,) of normalised points (N, 3), z = 1, against spheres at (N, 3) in the camera frame.

    The outline of a sphere is x^T E x = 0 with E^-1 = P Q^-1 P^T. In the camera frame P = [I | 0] and
    Q^-1 ~ [[r^2 I - c c^T, -c], [-c^T, -1]], hence E ~ (|c|^2 - r^2) I - c c^T.

    `algebraic`: x^T E x with E of unit Frobenius norm (no unit). `sampson`: x^T E x over the norm of its gradient in
    the image plane, the distance to the outline to first order, in units of the normalised plane.
    """
    return _value_and_gradient(points, centres_camera_m, radius_m, cost, derivative=False)[0]


def residuals_and_derivative(
    points: Array, centres_camera_m: Array, radius_m: float, cost: PointCost
) -> tuple[Array, Array]:
    """Residuals (N,) as from `residuals`, and their derivative (N, 3) by the centres."""
    return _value_and_gradient(points, centres_camera_m, radius_m, cost, derivative=True)


def _value_and_gradient(
    points: Array, centres: Array, radius_m: float, cost: PointCost, *, derivative: bool
) -> tuple[Array, Array]:
    xx = np.einsum("nj,nj->n", points, points)
    cx = np.einsum("nj,nj->n", centres, points)
    cc = np.einsum("nj,nj->n", centres, centres)
    a = cc - radius_m**2
    value = a * xx - cx**2
    d_value = 2 * (xx[:, None] * centres - cx[:, None] * points) if derivative else np.empty((0, 3))
    if cost == "algebraic":
        # |a I - c c^T|_F^2 = 3 a^2 - 2 a |c|^2 + |c|^4
        norm2 = 3 * a**2 - 2 * a * cc + cc**2
        norm = np.sqrt(norm2)
        if derivative:
            d_norm2 = (6 * a - 2 * cc - 2 * a + 2 * cc)[:, None] * 2 * centres
            d_value = d_value / norm[:, None] - (value / (2 * norm2 * norm))[:, None] * d_norm2
        return value / norm, d_value
    g = 2 * (a[:, None] * points[:, :2] - cx[:, None] * centres[:, :2])
    length = np.linalg.norm(g, axis=1)
    if derivative:
        # d g_i / d c_j = 2 (2 c_j x_i - x_j c_i - (c.x) delta_ij), i in the image plane
        along = np.einsum("ni,ni->n", g, points[:, :2])
        across = np.einsum("ni,ni->n", g, centres[:, :2])
        d_length = 2 * (2 * along[:, None] * centres - across[:, None] * points)
        d_length[:, :2] -= 2 * cx[:, None] * g
        d_length /= length[:, None]
        d_value = d_value / length[:, None] - (value / length**2)[:, None] * d_length
    return value / length, d_value
