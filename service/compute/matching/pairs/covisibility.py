"""Which points of the surface each view sees, how much two views share, and the graph of views that share some."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from service.compute.matching.pairs.loader import VISIBLE, View, look_up
from service.core.geometry import Array

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
        """Pairs of views, first < second, whose overlap is at least this in both directions."""
        both = np.minimum(self.overlap, self.overlap.T) >= least_overlap
        return [(int(i), int(j)) for i, j in np.argwhere(np.triu(both & (self.common > 0), k=1))]

    def components(self, least_overlap: float = LEAST_OVERLAP) -> NDArray[np.int64]:
        """(V,) number of the connected part of the graph of these pairs that each view belongs to."""
        edges = np.array(self.pairs(least_overlap), dtype=np.int64).reshape(-1, 2)
        n = len(self.seen)
        graph = csr_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(n, n))
        _, label = connected_components(graph, directed=False)
        return np.asarray(label, dtype=np.int64)


def points_seen(points_m: Array, view: View) -> NDArray[np.bool_]:
    """Mask (P,) of the surface points (P, 3) that a view shows: neither occluded nor covered by a marker."""
    return look_up(points_m, view)[1] == VISIBLE


def covisibility(seen: NDArray[np.bool_]) -> Covisibility:
    """Overlaps of views that see these points (V, P), which lie evenly on the surface.

    The overlap of a with b is |points of both| / |points of a|. Only the numerator is symmetric: a close view may lie
    within a far one.
    """
    counts = seen.astype(np.float32)
    common = np.rint(counts @ counts.T).astype(np.int64)  # exact below 2^24 points
    own = np.diag(common)
    overlap = common / np.maximum(own, 1)[:, None]
    return Covisibility(seen, common, overlap)
