"""Lists the pairs of a set of views: what both see, relative pose with its covariance, and difficulty."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from service.compute.matching.loader import VISIBLE, Pair, View, look_up
from service.core.geometry import Array, Transform, inverse, skew
from service.core.units import deg

LEAST_OVERLAP = 0.1  # of the points of either view: less does not make a pair


@dataclass(frozen=True, slots=True)
class Covisibility:
    """Points of the surface that views see.

    Attributes:
        seen: (V, P) whether a view sees a point.
        overlap: (V, V) share of the points of the row's view that the column's view sees as well.
        common: (V, V) number of points that both see.
    """

    seen: NDArray[np.bool_] = field(repr=False)
    common: NDArray[np.int64] = field(repr=False)
    overlap: Array = field(repr=False)

    def pairs(self, least_overlap: float = LEAST_OVERLAP) -> list[tuple[int, int]]:
        """Return the pairs of views, first < second, whose overlap is at least this in both directions."""
        both = np.minimum(self.overlap, self.overlap.T) >= least_overlap
        return [(int(i), int(j)) for i, j in np.argwhere(np.triu(both & (self.common > 0), k=1))]

    def components(self, least_overlap: float = LEAST_OVERLAP) -> NDArray[np.int64]:
        """Return (V,) number of the connected part of the graph of these pairs that each view belongs to."""
        edges = np.array(self.pairs(least_overlap), dtype=np.int64).reshape(-1, 2)
        n = len(self.seen)
        graph = csr_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
        _, label = connected_components(graph, directed=False)
        return np.asarray(label, dtype=np.int64)


def points_seen(points_m: Array, view: View) -> NDArray[np.bool_]:
    """Return the mask (P,) of surface points (P, 3) that a view shows: not occluded or covered by a marker."""
    return look_up(points_m, view)[1] == VISIBLE


def covisibility(seen: NDArray[np.bool_]) -> Covisibility:
    """Return the overlaps of views that see these points (V, P), which lie evenly on the surface.

    The overlap of a with b is |points of both| / |points of a|. Only the numerator is symmetric: a close view may lie
    within a far one.
    """
    counts = seen.astype(np.float32)
    common = np.rint(counts @ counts.T).astype(np.int64)  # exact below 2^24 points
    own = np.diag(common)
    overlap = common / np.maximum(own, 1)[:, None]
    return Covisibility(seen, common, overlap)


def relative_pose(T_world_first: Transform, T_world_second: Transform) -> Transform:
    """Return T_second_first (4, 4): maps points of the first camera's frame to the second's."""
    return inverse(T_world_second) @ T_world_first


def relative_covariance(T_world_first: Transform, T_world_second: Transform, joint: Array) -> Array:
    """Return (6, 6) covariance of T_second_first from the joint covariance of both poses.

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
        joint: (12, 12) covariance of (d', w') of the first and (d, w) of the second pose, with their correlations, m
            and rad.
    """
    R = T_world_second[:3, :3]
    J = np.zeros((6, 12))
    J[:3, :3], J[3:, 3:6] = R.T, R.T
    J[:3, 6:9], J[3:, 9:] = -R.T, -R.T
    J[:3, 9:] = R.T @ skew(T_world_first[:3, 3] - T_world_second[:3, 3])
    return J @ joint @ J.T


CLASSES = ("easy", "medium", "hard", "extreme")
MOST_ANGLE_DEG = (15.0, 30.0, 45.0)  # of easy, medium and hard pairs; beyond, a pair is extreme
MOST_SCALE = (1.2, 1.5, 2.0)
OVERLAP_STEPS = (0.6, 0.4, 0.2)


@dataclass(frozen=True, slots=True)
class Difficulty:
    """The measures that make a pair difficult.

    Attributes:
        angle_deg: median angle at the common points between the rays to both cameras.
        scale: median ratio of the sizes of the common points' surroundings in both images, at least 1.
        overlap: smaller one of the overlaps in both directions.
    """

    angle_deg: float
    scale: float
    overlap: float

    @property
    def name(self) -> str:
        """The class: that of the worst of the three."""
        by_angle = int(np.searchsorted(MOST_ANGLE_DEG, self.angle_deg))
        by_scale = int(np.searchsorted(MOST_SCALE, self.scale))
        by_overlap = sum(self.overlap < least for least in OVERLAP_STEPS)
        return CLASSES[max(by_angle, by_scale, by_overlap)]


def difficulty(common_m: Array, first: View, second: View, overlap: float) -> Difficulty:
    """Return the difficulty of a pair with these common points (N, 3), N > 0, in the world frame."""
    rays = [common_m - view.T_world_camera[:3, 3] for view in (first, second)]
    cosine = np.sum(rays[0] * rays[1], axis=1) / np.prod([np.linalg.norm(ray, axis=1) for ray in rays], axis=0)
    angle_rad = float(np.median(np.arccos(np.clip(cosine, -1.0, 1.0))))
    sizes = [
        view.K[0, 0] / (ray @ view.T_world_camera[:3, 2]) for view, ray in zip((first, second), rays, strict=True)
    ]
    ratio = float(np.median(sizes[0] / sizes[1]))
    return Difficulty(deg(angle_rad), max(ratio, 1.0 / ratio), overlap)


@dataclass(frozen=True, slots=True)
class ListedPair:
    """A pair of views.

    Attributes:
        first, second: names, in order.
        overlap: share of the points of the first view that the second sees too, and of the second view's.
        common_points: number of points that both see.
        difficulty: its measures and class.
        T_second_first: (4, 4), m.
        covariance: (6, 6) covariance of it, as `relative_covariance`; None where the poses' own errors are not known.
    """

    first: str
    second: str
    overlap: tuple[float, float]
    common_points: int
    difficulty: Difficulty
    T_second_first: Transform = field(repr=False)
    covariance: Array | None = field(repr=False)

    def record(self) -> Pair:
        """Return the pair as pairs.json has it."""
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
    """List the pairs of views that overlap, in the order of their names.

    Args:
        views: views by name, in the order of `covisible`; their depth is not needed.
        points_m: (P, 3) points of the surface, in the world frame.
        covisible: the points that each view sees.
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
    """Return (12, 12) part of a joint covariance that belongs to two poses."""
    rows = np.concatenate([6 * i + np.arange(6), 6 * j + np.arange(6)])
    return errors[np.ix_(rows, rows)]
