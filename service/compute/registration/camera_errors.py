"""Errors of the cameras' poses in the scan, as a registration of metric poses states them."""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag

from service.compute.registration.result import RegistrationResult, Solution
from service.core.errors import DataError
from service.core.geometry import Array, skew


def camera_errors(registration: RegistrationResult, *, refined: bool) -> Array:
    """(6 N, 6 N) joint covariance of `T_scan_camera`, or of `T_scan_camera_refined`.

    Of (d, w) of each pose: exp([w]x) R, t + d, in the axes of the scan, m and rad. It is whole: the registration's
    share is in it. Rows of images at stations without outlines are NaN.

    With B = T_base_scan of an image's station, R its rotation and a the vector from its origin to the camera,
    d_scan = R^T (d - d_B + a x w_B) and w_scan = R^T (w - w_B), where xi = (d, w) is the error of the pose in its
    base. The outlines tell of it that xi = xi_0 + K x + own error, with x the error of the common unknowns, whose
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
    """(n, n) covariances of the common unknowns: with the lens as calibrated, and what its errors then cause.

    An error e of the lens is one of V e of the unknowns, V the regression of their errors on those of the lens.
    """
    lens = slice(s.problem.lens_column, s.problem.size)
    left_open = s.covariance[lens, lens]
    V = np.linalg.solve(left_open, s.covariance[lens]).T
    prior = np.linalg.inv(s.problem.prior()[lens, lens])
    return s.covariance - V @ left_open @ V.T, V @ prior @ V.T
