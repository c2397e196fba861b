"""Suggests the viewpoints that bring the predicted target error below its limit soonest; greedy, by information."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from service.compute.planning.information import point_sigmas_m, pose_covariance
from service.core.errors import ComputeError
from service.core.geometry import Array

_AS_GOOD = 1.01  # errors within 1 % count as equal; coverage and travel then decide


@dataclass(frozen=True, slots=True)
class ViewGain:
    """A possible viewpoint and its predicted gain."""

    name: str
    information: Array = field(repr=False)  # (6, 6), see planning.information
    seen: NDArray[np.bool_] = field(repr=False)  # (N,) points of the coverage surface that it sees
    travel_s: float = 0.0


@dataclass(frozen=True, slots=True)
class CurrentInformation:
    """The information from the station's images so far."""

    informations: tuple[Array, ...] = field(repr=False)
    pose_covariance: Array = field(repr=False)  # P (6, 6), the arm's scatter
    targets_m: Array = field(repr=False)  # (T, 3) target points relative to the scene's centre, base axes
    seen_count: NDArray[np.int64] = field(repr=False)  # (N,) views of each surface point from all stations
    min_views: int = 2
    shared: Array | None = field(default=None, repr=False)  # (6, 6) covariance that further views do not reduce

    def error_m(self, *more: Array) -> float:
        """Predicted error of the worst target, m, with this further information added; infinite if undetermined."""
        try:
            covariance = pose_covariance([*self.informations, *more], self.pose_covariance)
        except ComputeError:
            return float("inf")
        if self.shared is not None:
            covariance = covariance + self.shared
        return float(point_sigmas_m(covariance, self.targets_m).max())


@dataclass(frozen=True, slots=True)
class Suggestion:
    """A suggested viewpoint, and the predicted results once it and those before it are taken."""

    name: str
    predicted_error_m: float
    coverage: float


def next_best_views(
    present: CurrentInformation,
    candidates: Sequence[ViewGain],
    *,
    limit_m: float,
    min_coverage: float,
    at_most: int = 6,
) -> tuple[Suggestion, ...]:
    """The shortest greedy list of viewpoints that brings error and coverage within limits, or `at_most` of them.

    While the error exceeds its limit, each choice minimises it; among equals, the one with the largest coverage, then
    the nearest wins. After that, each choice maximises coverage.
    """
    chosen: list[Suggestion] = []
    informations: list[Array] = []
    count = present.seen_count.copy()
    error = present.error_m()
    left = list(candidates)
    while left and len(chosen) < at_most:
        coverage = _covered(count, present.min_views)
        if error <= limit_m and coverage >= min_coverage:
            break
        errors = np.array([present.error_m(*informations, c.information) for c in left])
        gains = np.array([_gain(count, c.seen, present.min_views) for c in left])
        if error > limit_m and np.isfinite(errors.min()):
            equal = [i for i in range(len(left)) if errors[i] <= _AS_GOOD * errors.min()]
        else:
            equal = list(range(len(left)))
        best = min(equal, key=lambda i: (-round(float(gains[i]), 3), left[i].travel_s, left[i].name))
        pick = left.pop(best)
        informations.append(pick.information)
        count = count + pick.seen
        error = float(errors[best])
        chosen.append(Suggestion(pick.name, error, _covered(count, present.min_views)))
    return tuple(chosen)


def _covered(count: NDArray[np.int64], min_views: int) -> float:
    return float(np.mean(count >= min_views)) if len(count) else 0.0


def _gain(count: NDArray[np.int64], seen: NDArray[np.bool_], min_views: int) -> float:
    """Progress of all points towards `min_views`, so that a first view of a point counts too."""
    if not len(count):
        return 0.0
    return float(np.mean(np.minimum(count + seen, min_views) - np.minimum(count, min_views))) / min_views
