"""Computes the residuals of outlines, the paper's x^T E x or Sampson's distance, and says how they are solved."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from service.core.geometry import Array

PointCost = Literal["sampson", "algebraic"]
Cost = Literal["cone", "sampson", "algebraic"]


def residuals(points: Array, centres_camera_m: Array, radius_m: float, cost: PointCost) -> Array:
    """Return signed residuals (N,) of normalised points (N, 3), z = 1, against spheres at (N, 3) in the camera frame.

    The outline of a sphere is x^T E x = 0 with E^-1 = P Q^-1 P^T. In the camera frame P = [I | 0] and
    Q^-1 ~ [[r^2 I - c c^T, -c], [-c^T, -1]], hence E ~ (|c|^2 - r^2) I - c c^T.

    `algebraic`: x^T E x with E of unit Frobenius norm (no unit). `sampson`: x^T E x over the norm of its gradient in
    the image plane, the distance to the outline to first order, in units of the normalised plane.
    """
    return _value_and_gradient(points, centres_camera_m, radius_m, cost, derivative=False)[0]


def residuals_and_derivative(
    points: Array, centres_camera_m: Array, radius_m: float, cost: PointCost
) -> tuple[Array, Array]:
    """Return the residuals (N,) as from `residuals`, and their derivative (N, 3) by the centres."""
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


@dataclass(frozen=True, slots=True)
class CommonErrors:
    """Standard deviations, in px, of errors shared by all outlines of a capture.

    `shift_px`: in x and in y of the image; `growth_px`: of the radius. Views from different sides separate both from
    the registration, so they are estimated. `light_px`: displacement of all spheres in one direction of space, per
    coordinate, at their mean distance: under light from one side, the detected edge is biased differently on the lit
    and on the dark limb. No view separates it from a displacement of the scan, so this part of the predicted error
    remains however many images are taken. `own_light_px`: displacement, per coordinate, of each sphere by light that
    is its own, from the specimen and the table beside it, alike in all images: it counts as an error of the sphere's
    centre in what is given, but is not estimated, since it would take up other errors.
    """

    shift_px: float
    growth_px: float
    light_px: float
    own_light_px: float = 0.0


# Under light from one side, the detected edge is biased differently on the lit and on the dark limb. The mean of this
# bias around the outline is growth, the difference between the sides is light; both are similar in size. Truth on ten
# rendered scenes with outlines of 60 px radius: growth -0.020…-0.031 px, light 0.016 px rms per coordinate, shift
# 0.003 px in x and 0.008 px in y rms; on three with 150 px radius: growth -0.008 px, light 0.017 px
# (accuracy.py and registration_sigma.py in bench/registration). Other lights, colours and another renderer
# (bench/markers/outlines.py) gave growth of -0.04 px and displacements of single images of 0.05 px rms, so light is
# set above what the first renderer requires. Truth of single spheres in whole runs on simulated rigs, less the noise:
# 0.029 px rms per coordinate at 960 px, 0.009 px at 1280 px (bench/whole_runs/stated_sigma.py).
EXPECTED_COMMON_ERRORS = CommonErrors(shift_px=0.015, growth_px=0.03, light_px=0.02, own_light_px=0.02)


@dataclass(frozen=True, slots=True)
class RegistrationSettings:
    """The unknowns of a registration, its residual, and the uncertainty of what is given.

    Attributes:
        cost: `cone` uses the three parameters and their covariance; `sampson` the points' geometric distances;
            `algebraic` is the paper's plain x^T E x.
        robust: true to weight outlines robustly and exclude outliers.
        pose_covariance: (N, 6, 6) covariance of each pose's (position in the unit of the poses, rotation vector in
            radians) in the axes of its base, independent between images; "estimate": isotropic, estimated from the
            residuals; "exact": no pose errors; "free": the outlines alone determine where each camera was.
        intrinsics_covariance: (4, 4) covariance of fx, fy, cx, cy or (8, 8) of these and k1, k2, p1, p2; only for
            poses whose errors do not depend on the intrinsics'. None leaves them to the error budget.
        common_errors: prior sizes of errors shared by all outlines of a capture.
    """

    cost: Cost = "cone"
    robust: bool = True
    pose_covariance: Array | Literal["estimate", "exact", "free"] = field(default="estimate", repr=False)
    intrinsics_covariance: Array | None = field(default=None, repr=False)
    common_errors: CommonErrors = EXPECTED_COMMON_ERRORS
