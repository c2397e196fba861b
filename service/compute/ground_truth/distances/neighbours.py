"""Nearest neighbours between large sets of points, by a k-d tree.

Points and queries are visited in an order in which neighbours follow one another, which matters more than the choice
of tree: in random order a search takes several times as long (bench/results/chamfer-*.md).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pykdtree.kdtree import KDTree

from service.compute.ground_truth.surface import IntArray
from service.core.geometry import Array

_CHUNK = 1_000_000  # queries at a time, which limits the memory
_PROBE = 4096  # consecutive points that are looked at to tell whether their order is spatial
_NEAR = 0.02  # of the extent: a usual step between consecutive points in spatial order is shorter


class PointIndex:
    """Points (N, 3) in which the nearest to any place can be found."""

    def __init__(self, points_m: Array) -> None:
        self._order = spatial_order(points_m)
        points = points_m if self._order is None else points_m[self._order]
        self._tree = KDTree(np.ascontiguousarray(points, dtype=np.float64))

    def nearest(self, queries_m: Array, within_m: float = np.inf) -> tuple[Array, IntArray]:
        """Distance (Q,) in metres from each query (Q, 3) to the nearest point, and that point's index (Q,).

        With no point nearer than `within_m`, the distance is infinite and the index -1. A bound makes the search
        many times faster for queries that are far from all points.
        """
        order = spatial_order(queries_m)
        distance, index = np.empty(len(queries_m)), np.empty(len(queries_m), dtype=np.int64)
        for begin in range(0, len(queries_m), _CHUNK):
            end = min(begin + _CHUNK, len(queries_m))
            part: slice | IntArray = slice(begin, end) if order is None else order[begin:end]
            queries = np.ascontiguousarray(queries_m[part], dtype=np.float64)
            d, i = self._tree.query(queries, distance_upper_bound=within_m)
            distance[part] = d
            found = np.isfinite(d)
            i[~found] = 0
            index[part] = i if self._order is None else self._order[i]
            if not found.all():
                index[part] = np.where(found, index[part], -1)
        return distance, index

    def neighbours(self, queries_m: Array, k: int) -> IntArray:
        """(Q, k) indices of the k points nearest to each query (Q, 3), the nearest first."""
        index = self._tree.query(np.ascontiguousarray(queries_m, dtype=np.float64), k=k)[1].astype(np.int64)
        return index if self._order is None else self._order[index]


def spatial_order(points: Array) -> IntArray | None:
    """An order (N,) along a Z curve; None if consecutive points (N, 3) are mostly neighbours already."""
    if len(points) < _PROBE:
        return None
    begin = np.linspace(0, len(points) - 2, _PROBE).astype(np.int64)
    extent = float(np.max(np.ptp(points[begin], axis=0)))  # nearly that of all points, and much faster
    steps = np.linalg.norm(points[begin + 1] - points[begin], axis=1)
    if extent == 0 or float(np.median(steps)) < _NEAR * extent:
        return None
    return z_order(points)


def z_order(points: Array) -> IntArray:
    """The order (N,) of points (N, 3) along a Z curve, so that neighbours are mostly near one another."""
    low = points.min(axis=0)
    extent = max(float(np.max(points.max(axis=0) - low)), 1e-300)
    cells = ((points - low) * (((1 << 21) - 1) / extent)).astype(np.uint64)
    x, y, z = (_spread(cells[:, k]) for k in range(3))
    return np.argsort(x | (y << np.uint64(1)) | (z << np.uint64(2)))


def _spread(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """The 21 lowest bits with two zeros between each: a Morton code's part."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        x = (x | (x << np.uint64(shift))) & np.uint64(mask)
    return x
