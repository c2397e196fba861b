"""Judges whether an arm stands still, for settling after a motion and for exposures alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivers.interfaces import RobotSample, SettleCriteria
from service.core.geometry import Transform, transform


@dataclass(frozen=True, slots=True)
class PoseSpread:
    """The mean of several flange poses and their spread around it.

    The peak-to-peak values are the diagonals of the bounding boxes of the positions and of the rotation vectors
    relative to the mean rotation: never below the largest distance between two samples. A sigma is the standard
    deviation over all three axes: the root of the sum of their variances.
    """

    T_base_flange: Transform  # mean position and mean rotation
    samples: int
    position_peak_to_peak_m: float
    rotation_peak_to_peak_rad: float
    position_sigma_m: float
    rotation_sigma_rad: float

    def within(self, criteria: SettleCriteria) -> bool:
        """Return whether both peak-to-peak values are below those of the settle criteria."""
        return (
            self.position_peak_to_peak_m < criteria.position_peak_to_peak_m
            and self.rotation_peak_to_peak_rad < criteria.rotation_peak_to_peak_rad
        )


def pose_spread(samples: Sequence[RobotSample]) -> PoseSpread:
    """Compute the mean and the spread of the flange poses of at least one sample."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - half a second, which most commands do without

    T = np.stack([s.T_base_flange for s in samples])
    positions = T[:, :3, 3]
    rotations = Rotation.from_matrix(T[:, :3, :3])
    mean = rotations.mean()
    turns = (mean.inv() * rotations).as_rotvec()
    return PoseSpread(
        T_base_flange=transform(mean, positions.mean(axis=0)),
        samples=len(samples),
        position_peak_to_peak_m=float(np.linalg.norm(np.ptp(positions, axis=0))),
        rotation_peak_to_peak_rad=float(np.linalg.norm(np.ptp(turns, axis=0))),
        position_sigma_m=float(np.sqrt(positions.var(axis=0).sum())),
        rotation_sigma_rad=float(np.sqrt(turns.var(axis=0).sum())),
    )
