"""The pairs of a set of views: overlap, difficulty and relative pose of each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from service.compute.matching.pairs.covisibility import Covisibility
from service.compute.matching.pairs.difficulty import Difficulty, difficulty
from service.compute.matching.pairs.loader import Pair, View
from service.compute.matching.pairs.relative_pose import relative_covariance, relative_pose
from service.core.geometry import Array, Transform


@dataclass(frozen=True, slots=True)
class ListedPair:
    """A pair of views.

    Attributes:
        first, second: names, in order.
        overlap: share of the points of the first view that the second sees too, and of the second view's.
        common_points: that both see.
        difficulty: its measures and class.
        T_second_first: (4, 4), m.
        covariance: (6, 6) of it, as `relative_covariance`; None where the poses' own errors are not known.
    """

    first: str
    second: str
    overlap: tuple[float, float]
    common_points: int
    difficulty: Difficulty
    T_second_first: Transform = field(repr=False)
    covariance: Array | None = field(repr=False)

    def record(self) -> Pair:
        """The pair as pairs.json has it."""
        return {
            "first": self.first,
            "second": self.second,
            "difficulty": self.difficulty.name,
            "overlap_first": self.overlap[0],
            "overlap_second": self.overlap[1],
            "common_points": self.common_points,
            "angle_deg": self.difficulty.angle_deg,
            "scale": self.difficulty.scale,
            "T_second_first": self.T_second_first.tolist(),
            "covariance": None if self.covariance is None else self.covariance.tolist(),
        }


def listed_pairs(
    views: Mapping[str, View], points_m: Array, covisible: Covisibility, errors: Array | None = None
) -> list[ListedPair]:
    """The pairs of views that overlap, in the order of their names.

    Args:
        views: by name, in the order of `covisible`; their depth is not needed.
        points_m: (P, 3) points of the surface, in the world frame.
        covisible: what the views see of them.
        errors: (6 V, 6 V) joint covariance of the poses; errors common to all cancel; None if unknown.
    """
    names = list(views)
    found: list[ListedPair] = []
    for i, j in covisible.pairs():
        first, second = views[names[i]], views[names[j]]
        if np.array_equal(first.T_world_camera[:3, 3], second.T_world_camera[:3, 3]):
            continue  # parts of one photograph
        overlap = (float(covisible.overlap[i, j]), float(covisible.overlap[j, i]))
        common = points_m[covisible.seen[i] & covisible.seen[j]]
        T = (first.T_world_camera, second.T_world_camera)
        joint = None if errors is None else _of_pair(errors, i, j)
        found.append(
            ListedPair(
                names[i],
                names[j],
                overlap,
                len(common),
                difficulty(common, first, second, min(overlap)),
                relative_pose(*T),
                None if joint is None else relative_covariance(*T, joint),
            )
        )
    return found


def _of_pair(errors: Array, i: int, j: int) -> Array:
    """(12, 12) part of a joint covariance that belongs to two poses."""
    rows = np.concatenate([6 * i + np.arange(6), 6 * j + np.arange(6)])
    return errors[np.ix_(rows, rows)]
