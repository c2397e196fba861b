"""Registration covariance for camera poses with correlated errors (structure from motion)."""

from __future__ import annotations

import dataclasses

import numpy as np

from service.compute.registration.result import RegistrationResult
from service.core.errors import DataError
from service.core.geometry import Array


def with_joint_pose_covariance(registration: RegistrationResult, covariance: Array) -> RegistrationResult:
    """Replace the covariance of a registration by the one for poses from a joint adjustment.

    Errors of neighbouring images in a reconstruction are correlated, so they do not average out like independent
    ones. The estimate is linear in them: with H the information on the common unknowns x, and xi the poses' errors,
    dx = -H^-1 sum_i J' R_i^-1 A_i xi_i, so their part of the covariance is K C K'. It replaces the component "poses".
    With a scale, the result is the covariance of the scan's position relative to the cameras, aligned to the true
    ones by their positions: a scale error that moves the scan with all cameras does not count.

    Args:
        registration: of all images in `covariance`, in the same order.
        covariance: (6 N, 6 N) of the poses given to `register` (positions in their unit, rotation vectors), from
            `similarity_covariance`.

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
