"""Which viewpoints bring the predicted target error under its limit soonest: greedy on the views' information."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from service.compute.planning.information import point_sigmas_m, pose_covariance
from service.core.errors import ComputeError
from service.core.geometry import Array

_AS_GOOD = 1.01  # errors within a hundredth count as equal; coverage and travel decide between them


@dataclass(frozen=True, slots=True)
class Candidate:
    """A viewpoint that could be taken, and what it would bring."""

    name: str
    information: Array = field(repr=False)  # (6, 6), see planning.information
    seen: NDArray[np.bool_] = field(repr=False)  # (N,) points of the coverage surface
    travel_s: float = 0.0


@dataclass(frozen=True, slots=True)
class CurrentInformation:
    """What the station's images have brought so far."""

    informations: tuple[Array, ...] = field(repr=False)
    pose_covariance: Array = field(repr=False)  # P (6, 6), the arm's scatter
    targets_m: Array = field(repr=False)  # (T, 3) points that matter, relative to the scene's centre, base axes
    seen_count: NDArray[np.int64] = field(repr=False)  # (N,) views of each surface point, of all stations
    min_views: int = 2
    shared: Array | None = field(default=None, repr=False)  # (6, 6) of what no further view makes better

    def error_m(self, *more: Array) -> float:
        """Predicted error of the worst target with these further informations; infinite if undetermined."""
        try:
            covariance = pose_covariance([*self.informations, *more], self.pose_covariance)
        except ComputeError:
            return float("inf")
        if self.shared is not None:
            covariance = covariance + self.shared
        return float(point_sigmas_m(covariance, self.targets_m).max())


@dataclass(frozen=True, slots=True)
class Suggestion:
    """A viewpoint to take next, with what holds once it and those before it are taken."""

    name: str
    predicted_error_m: float
    coverage: float


def next_best_views(
    present: CurrentInformation,
    candidates: Sequence[Candidate],
    *,
    limit_m: float,
    min_coverage: float,
    at_most: int = 6,
) -> tuple[Suggestion, ...]:
    """The shortest greedy list of viewpoints after which error and coverage keep their limits, or `at_most` of them.

    While the error is above its limit, each choice is the candidate after which it is least, among equals the one
    that covers most, then the nearest; after that, the one that covers most.
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
    """Progress towards `min_views` of every point, so that a first look counts too."""
    if not len(count):
        return 0.0
    return float(np.mean(np.minimum(count + seen, min_views) - np.minimum(count, min_views))) / min_views
