"""The robust mean of poses that should all be equal, such as those of one camera in the frame of another."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.compute.descent import gauss_newton
from service.core.errors import DataError
from service.core.geometry import Array, Transform, increment

_OUTLIER_CHI2 = 22.46  # of six degrees of freedom: exceeded by chance once in a thousand
_MEDIAN_CHI2 = 5.348  # of six degrees of freedom
_ROUNDS = 20


@dataclass(frozen=True, slots=True)
class RigidMean:
    """The mean of N poses.

    Attributes:
        T: (4, 4) T_a_b.
        covariance: (6, 6) of (d, w) of `T`: exp([w]x) R, t + d, m and rad. It follows the scatter of the poses where
            that is larger than their stated covariances.
        chi2_reduced: of the poses that were kept, against their stated covariances; 1 for a single pose.
        kept: (N,) poses that agree with the mean.
        deviations: (N, 6) of (d, w) of every pose from the mean, m and rad.
    """

    T: Transform
    covariance: Array = field(repr=False)
    chi2_reduced: float
    kept: NDArray[np.bool_] = field(repr=False)
    deviations: Array = field(repr=False)

    @property
    def rms_m(self) -> float:
        """Root mean square distance of the kept poses from the mean."""
        return _rms(self.deviations[self.kept, :3])

    @property
    def rms_rad(self) -> float:
        """Root mean square angle of the kept poses from the mean."""
        return _rms(self.deviations[self.kept, 3:])


def rigid_mean(poses: Array, covariances: Array) -> RigidMean:
    """The pose T on which most of N independent measurements of it agree, weighted by their covariances.

    It minimises the sum of squared Mahalanobis distances of the poses that agree; the others are excluded. A distance
    is judged against the stated covariances times a common factor, the median distance over its expectation, if that
    is above 1: so the poses may scatter more than stated, as long as few stand out. If all contradict one another,
    none is excluded, and `covariance`, `chi2_reduced` and `rms_m` show it.

    Args:
        poses: (N, 4, 4) measurements of T.
        covariances: (N, 6, 6) of (d, w) of each, positive definite.

    Raises:
        DataError: the shapes do not agree, or there is no pose.
    """
    n = len(poses)
    if n == 0 or poses.shape != (n, 4, 4) or covariances.shape != (n, 6, 6):
        raise DataError(f"{poses.shape} poses and {covariances.shape} covariances")
    weights = np.asarray(np.linalg.inv(covariances), dtype=np.float64)
    mean, kept = poses[_middle(poses, weights)], np.ones(n, dtype=np.bool_)
    for _ in range(_ROUNDS):  # the nearer a pose, the more it counts, so that the start does not decide
        chi2 = _chi2(_deviations(poses, mean), weights)
        nearness = 1.0 / (1.0 + chi2 / (6 * _scatter(chi2)))
        mean = _mean(poses, weights * nearness[:, None, None], mean)
    for _ in range(_ROUNDS):
        chi2 = _chi2(_deviations(poses, mean), weights)
        agree = chi2 <= _OUTLIER_CHI2 * _scatter(chi2)
        mean = _mean(poses[agree], weights[agree], mean)
        if np.array_equal(agree, kept):
            break
        kept = agree
    deviations = _deviations(poses, mean)
    chi2 = _chi2(deviations[kept], weights[kept])
    count = int(kept.sum())
    reduced = float(chi2.sum() / (6 * (count - 1))) if count > 1 else 1.0
    covariance = max(1.0, reduced) * np.linalg.inv(weights[kept].sum(axis=0))
    return RigidMean(mean, covariance, reduced, kept, deviations)


def _middle(poses: Array, weights: Array) -> int:
    """The pose from which the median distance to all poses is least."""
    return int(np.argmin([np.median(_chi2(_deviations(poses, T), weights)) for T in poses]))


def _scatter(chi2: Array) -> float:
    return max(1.0, float(np.median(chi2)) / _MEDIAN_CHI2)


def _mean(poses: Array, weights: Array, start: Transform) -> Transform:
    total = np.linalg.inv(weights.sum(axis=0))

    def step(T: Transform) -> Array:
        return total @ np.einsum("nij,nj->i", weights, _deviations(poses, T))

    return gauss_newton(start, step, lambda T, d: increment(T, d[:3], d[3:]), most=_ROUNDS, settled=1e-12)


def _deviations(poses: Array, T: Transform) -> Array:
    """(N, 6) (d, w) with which T becomes each pose."""
    turned = Rotation.from_matrix(poses[:, :3, :3] @ T[:3, :3].T).as_rotvec()
    return np.hstack([poses[:, :3, 3] - T[:3, 3], turned])


def _chi2(deviations: Array, weights: Array) -> Array:
    return np.einsum("ni,nij,nj->n", deviations, weights, deviations)


def _rms(rows: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(rows**2, axis=1)))) if len(rows) else 0.0
