"""The relative pose of two cameras and its covariance."""

from __future__ import annotations

import numpy as np

from service.core.geometry import Array, Transform, inverse, skew


def relative_pose(T_world_first: Transform, T_world_second: Transform) -> Transform:
    """T_second_first (4, 4): maps points of the first camera's frame to the second's."""
    return inverse(T_world_second) @ T_world_first


def relative_covariance(T_world_first: Transform, T_world_second: Transform, joint: Array) -> Array:
    """(6, 6) covariance of T_second_first from the joint covariance of both poses.

    Perturbations are those of the conventions, exp([w]x) R and t + d. With R, t of the second pose and R', t' of the
    first, the relative rotation R^T R' becomes R^T exp(-[w]x) exp([w']x) R', and the relative position R^T (t' - t)
    becomes R^T exp(-[w]x) (t' + d' - t - d). To first order

        d_rel = R^T (d' - d + (t' - t) x w),    w_rel = R^T (w' - w),

    so the covariance is J C J^T with these derivatives J (propagation to first order: Hartley and Zisserman,
    "Multiple View Geometry", 2nd edition, 5.2; for poses: Barfoot and Furgale, "Associating uncertainty with
    three-dimensional poses", IEEE T-RO 30(3), 2014). An error of the world's frame, such as that of a registration,
    is common to both: d = d0 + w0 x t, d' = d0 + w0 x t', w = w' = w0. It cancels exactly: d_rel = w_rel = 0. So
    `joint` may leave it out.

    Args:
        T_world_first: pose of the first camera.
        T_world_second: pose of the second camera.
        joint: (12, 12) of (d', w') of the first and (d, w) of the second pose, with their correlations, m and rad.
    """
    R = T_world_second[:3, :3]
    J = np.zeros((6, 12))
    J[:3, :3], J[3:, 3:6] = R.T, R.T
    J[:3, 6:9], J[3:, 9:] = -R.T, -R.T
    J[:3, 9:] = R.T @ skew(T_world_first[:3, 3] - T_world_second[:3, 3])
    return J @ joint @ J.T
