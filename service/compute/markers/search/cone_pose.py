"""The camera's pose from the cones of known spheres, robust against false ones."""

from __future__ import annotations

import numpy as np

from service.compute.descent import gauss_newton
from service.compute.markers.observed_cones import ObservedCones
from service.core.geometry import Array, Transform, increment, skew


def fit_pose(
    cones: ObservedCones, centres_m: Array, radius_m: float, start: Transform, iterations: int = 12
) -> Transform:
    """T_camera_scan from cones, by robust Gauss–Newton on their directions and sizes.

    Args:
        cones: N ≥ 3.
        centres_m: (N, 3) of the spheres, scan frame.
        radius_m: radius of the spheres.
        start: initial T_camera_scan.
        iterations: largest number.
    """
    seen = ObservedCones.with_chords(cones.axes, cones.half_angles)
    try:
        return gauss_newton(
            start,
            lambda pose: _pose_step(pose, seen, centres_m, radius_m),
            lambda pose, step: increment(pose, step[:3], step[3:]),
            most=iterations,
            settled=1e-9,
        )
    except _InsideSphereError:
        return start


class _InsideSphereError(Exception):
    """The camera would be inside a sphere."""


def _pose_step(pose: Transform, seen: ObservedCones, centres_m: Array, radius_m: float) -> Array:
    """One Gauss–Newton step (6,) of translation and rotation. Raises _InsideSphereError."""
    rotated = centres_m @ pose[:3, :3].T
    c = rotated + pose[:3, 3]
    if np.any(np.linalg.norm(c, axis=1) < 1.5 * radius_m):
        raise _InsideSphereError
    r, slope = seen.residuals(c, radius_m)
    residual = r / seen.half_angles[:, None]  # (N, 4) in radii
    by_centre = slope / seen.half_angles[:, None, None]  # (N, 4, 3)
    J = np.concatenate([by_centre, -by_centre @ skew(rotated)], axis=2)
    error = np.linalg.norm(residual, axis=1)
    scale = max(0.01, 1.5 * float(np.median(error)))
    weight = 1 / (1 + (error / scale) ** 2)
    H = np.einsum("n,nki,nkj->ij", weight, J, J)
    g = np.einsum("n,nki,nk->i", weight, J, residual)
    d = 1 / np.sqrt(np.maximum(np.diag(H), 1e-12))
    return -d * np.linalg.lstsq(H * np.outer(d, d), d * g, rcond=1e-12)[0]
