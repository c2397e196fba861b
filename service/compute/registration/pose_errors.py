"""Propagates errors of camera poses: correlated ones into a registration, and those that a registration reports."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.linalg import block_diag

from service.compute.registration.result import RegistrationResult, Solution
from service.core.errors import DataError
from service.core.geometry import Array, Transform, skew


def camera_errors(registration: RegistrationResult, *, refined: bool) -> Array:
    """Compute the (6 N, 6 N) joint covariance of `T_scan_camera`, or of `T_scan_camera_refined`.

    It is that of (d, w) of each pose: exp([w]x) R, t + d, in the axes of the scan, m and rad. It is whole: the
    registration's share is in it. Rows of images at stations without outlines are NaN.

    With B = T_base_scan of an image's station, R its rotation and a the vector from its origin to the camera,
    d_scan = R^T (d - d_B + a x w_B) and w_scan = R^T (w - w_B), where xi = (d, w) is the error of the pose in its
    base. The outlines show that xi = xi_0 + K x + own error, with x the error of the common unknowns, whose
    covariance is C, and own errors of covariance Q. Refined poses have xi_0 taken off. Given ones do not: the
    covariance of their xi is P, and that of xi with x is K C.

    Intrinsics, if uncertain, count with their whole covariance, not with what the outlines leave of it: the poses are
    those of the calibrated lens. So does light of their own on single spheres, which is not estimated.

    Raises:
        DataError: the scale was estimated, so that the poses are not metric.
    """
    s = registration.solution
    problem = s.problem
    if problem.with_scale:
        raise DataError("the errors of poses are stated for metric poses only")
    T_base_camera = s.state.cameras(problem, refined=refined)
    by_base = np.full((problem.n_images, 6, problem.size), np.nan)
    to_scan = np.full((problem.n_images, 6, 6), np.nan)
    for i, k in enumerate(problem.station):
        if k < 0:
            continue
        T_base_scan = s.state.bases[k]
        to_scan[i] = np.kron(np.eye(2), T_base_scan[:3, :3].T)
        moved = -np.eye(6)
        moved[:3, 3:] = skew(T_base_camera[i, :3, 3] - T_base_scan[:3, 3])
        by_base[i] = 0.0
        by_base[i, :, 6 * k : 6 * k + 6] = to_scan[i] @ moved
    by_base = by_base.reshape(-1, problem.size)
    by_pose = (to_scan @ s.pose_gain()).reshape(-1, problem.size)
    through = by_base + by_pose
    known, of_lens = _with_calibrated_lens(s)
    not_estimated = of_lens + s.by_own_light()
    joint = through @ known @ through.T
    if refined:
        joint += through @ not_estimated @ through.T
        covariance = s.marginal.Q
    else:
        joint += by_base @ not_estimated @ by_base.T - by_pose @ known @ by_pose.T
        covariance = s.pose_root @ s.pose_root.transpose(0, 2, 1)
    joint += block_diag(*(to_scan @ covariance @ to_scan.transpose(0, 2, 1)))
    return (joint + joint.T) / 2


def _with_calibrated_lens(s: Solution) -> tuple[Array, Array]:
    """Return (n, n) covariances of the common unknowns: with the lens as calibrated, and what its errors then cause.

    An error e of the lens is one of V e of the unknowns, V the regression of their errors on those of the lens.
    """
    lens = slice(s.problem.lens_column, s.problem.size)
    left_open = s.covariance[lens, lens]
    V = np.linalg.solve(left_open, s.covariance[lens]).T
    prior = np.linalg.inv(s.problem.prior()[lens, lens])
    return s.covariance - V @ left_open @ V.T, V @ prior @ V.T


def with_joint_pose_covariance(registration: RegistrationResult, covariance: Array) -> RegistrationResult:
    """Replace the covariance of a registration by the one for poses from a joint adjustment.

    Errors of neighbouring images in a reconstruction are correlated, so they do not average out like independent
    ones. The estimate is linear in them: with H the information on the common unknowns x, and xi the poses' errors,
    dx = -H^-1 sum_i J' R_i^-1 A_i xi_i, so their part of the covariance is K C K'. It replaces the component "poses".
    With a scale, the result is the covariance of the scan's position relative to the cameras, aligned to the true
    ones by their positions: a scale error that moves the scan with all cameras does not count.

    Args:
        registration: the registration of all images in `covariance`, in the same order.
        covariance: (6 N, 6 N) covariance of the poses given to `register` (positions in their unit, rotation
            vectors), from `similarity_covariance`.

    Raises:
        DataError: the covariance is for another number of images.
    """
    s = registration.solution
    n = len(s.blocks.JA)
    if covariance.shape != (6 * n, 6 * n):
        raise DataError(f"a joint covariance of shape {covariance.shape} does not fit {n} poses")
    unit = np.tile([registration.scale] * 3 + [1.0] * 3, n)
    metric = covariance * np.outer(unit, unit)
    f = s.outline_factor
    towards = s.blocks.JA / f - s.blocks.JA @ s.marginal.Q @ s.blocks.AA / f**2  # (N, n, 6)
    gain = s.covariance @ towards.transpose(1, 0, 2).reshape(-1, 6 * n)
    pick = [*range(6), s.problem.scale_column] if s.problem.with_scale else list(range(6))
    part = (gain @ metric @ gain.T)[np.ix_(pick, pick)]
    over = np.eye(len(pick))
    if s.problem.with_scale:
        positions = registration.T_world_scan @ registration.T_scan_camera
        over[:3, 6] = -np.nanmean(positions[:, :3, 3], axis=0)
    components = {
        name: over @ (part if name == "poses" else component) @ over.T
        for name, component in registration.components.items()
    }
    return dataclasses.replace(
        registration, components=components, covariance=np.sum(list(components.values()), axis=0)
    )


def of_inverse(T_a_b: Transform, covariance: Array) -> Array:
    """Return the covariance of T_b_a (6, 6) from that of T_a_b with R, t: d' = -R^T (d + t x w), w' = -R^T w."""
    R, t = T_a_b[:3, :3], T_a_b[:3, 3]
    J = np.zeros((6, 6))
    J[:3, :3], J[3:, 3:] = -R.T, -R.T
    J[:3, 3:] = -R.T @ skew(t)
    return J @ covariance @ J.T


def of_product(T_a_b: Transform, T_b_c: Transform, covariance_a_b: Array, covariance_b_c: Array) -> Array:
    """Return the covariance of T_a_c (6, 6) from those of its two independent factors."""
    by_a_b, by_b_c = product_jacobians(T_a_b, T_b_c)
    return by_a_b @ covariance_a_b @ by_a_b.T + by_b_c @ covariance_b_c @ by_b_c.T


def product_jacobians(T_a_b: Transform, T_b_c: Transform) -> tuple[Array, Array]:
    """Return the derivatives (6, 6) of T_a_c by T_a_b and by T_b_c."""
    R = T_a_b[:3, :3]
    moved, turned = np.eye(6), np.zeros((6, 6))
    moved[:3, 3:] = -skew(R @ T_b_c[:3, 3])
    turned[:3, :3], turned[3:, 3:] = R, R
    return moved, turned
