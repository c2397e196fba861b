"""Finds where a scan covers a CT well enough to replace it, and the wound in the rest, which a person may correct."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from service.compute.surfaces.surface import IntArray, PointIndex, Surface, closest_on_triangles
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, Transform, apply, inverse

Mask = NDArray[np.bool_]
_POINTS = 10_000  # compared with faces at a time, which fits into the processor's cache
_FACES = 1_000_000  # whose connections are looked at together


@dataclass(frozen=True, slots=True)
class OverlapLimits:
    """Conditions under which the scan replaces the CT's surface, in metres.

    Attributes:
        distance_m: largest distance between the two; beyond, they show different surfaces.
        cosine: least cosine between their normals.
        rim_m: width of the strip along the scan's holes and ends that is not used: there it was seen at a grazing
            angle.
    """

    distance_m: float = 0.0015
    cosine: float = 0.5
    rim_m: float = 0.001


@dataclass(frozen=True, slots=True)
class Overlap:
    """The nearest place of the scan (V, 3) for each vertex of the CT (V,), and whether the scan is good there.

    Attributes:
        nearest_m: (V, 3) nearest places of the scan.
        offset_m: (V,) height of the CT above the scan there, along the CT's outward normal.
        covered: (V,) true where the scan is good.
    """

    nearest_m: Array = field(repr=False)
    offset_m: Array = field(repr=False)
    covered: Mask = field(repr=False)


def overlap(ct: Surface, scan: Surface, limits: OverlapLimits | None = None) -> Overlap:
    """Compare a CT mesh with a scan, both in one frame, with outward faces."""
    bounds = limits or OverlapLimits()
    used = np.unique(scan.faces)
    reach_m = bounds.distance_m + _longest_edge(scan)
    rough, vertex = PointIndex(scan.vertices_m[used]).nearest(ct.vertices_m, reach_m)
    near = np.flatnonzero(np.isfinite(rough))
    normals = ct.vertex_normals
    nearest, covered = ct.vertices_m.copy(), np.zeros(len(rough), dtype=np.bool_)
    offset = np.full(len(rough), np.inf)
    around = _FacesAround(scan)
    for begin in range(0, len(near), _POINTS):
        part = near[begin : begin + _POINTS]
        place, face = around.nearest(used[vertex[part]], ct.vertices_m[part])
        way = ct.vertices_m[part] - place
        nearest[part] = place
        offset[part] = np.einsum("ni,ni->n", way, normals[part])
        covered[part] = (np.linalg.norm(way, axis=1) <= bounds.distance_m) & (
            np.einsum("ni,ni->n", normals[part], scan.normals_of(face)) >= bounds.cosine
        )
    rim = rim_vertices(scan)
    if len(rim):
        index = np.flatnonzero(covered)
        away = PointIndex(scan.vertices_m[rim]).nearest(nearest[index], bounds.rim_m)[0]
        covered[index[away < bounds.rim_m]] = False
    return Overlap(nearest, offset, covered)


class _FacesAround:
    """The faces around each vertex of a mesh."""

    def __init__(self, surface: Surface) -> None:
        corner = surface.faces.ravel()
        self._surface = surface
        self._order = np.argsort(corner, kind="stable")
        self._first = np.searchsorted(corner[self._order], np.arange(len(surface.vertices_m) + 1))

    def nearest(self, vertex: IntArray, points: Array) -> tuple[Array, IntArray]:
        """Find, among the faces around a vertex (N,), the place nearest to a point (N, 3), and the face that has it.

        With the vertex nearest to the point, that is nearly always the nearest place of the whole surface.
        """
        surface = self._surface
        count = np.diff(self._first)[vertex]
        best = np.full(len(points), np.inf)
        place, face = np.empty_like(points), np.zeros(len(points), dtype=np.int64)
        for k in range(int(count.max(initial=0))):
            index = np.flatnonzero(count > k)
            candidate = self._order[self._first[vertex[index]] + k] // 3
            p = closest_on_triangles(points[index], surface.vertices_m[surface.faces[candidate]])
            d = np.linalg.norm(p - points[index], axis=1)
            nearer = d < best[index]
            at = index[nearer]
            best[at], place[at], face[at] = d[nearer], p[nearer], candidate[nearer]
        return place, face


@dataclass(frozen=True, slots=True)
class WoundLimits:
    """The limits by which a part of the surface counts as a wound.

    Attributes:
        closing_m: uncovered places nearer than twice this to one another are one, with what lies between.
        least_area_m2: least area of its surface.
        least_depth_m: least mean depth below the rim.
        least_facing: least mean cosine between its normals and up, so that undersides and sides are none.
    """

    closing_m: float = 0.003
    least_area_m2: float = 5e-5
    least_depth_m: float = 0.002
    least_facing: float = 0.2


def propose_wound(ct: Surface, covered: Mask, up: Array, limits: WoundLimits | None = None) -> Mask:
    """Return (V,) vertices of the CT in hollows open upwards that the scan misses; all False if there are none.

    Args:
        ct: the CT's mesh.
        covered: (V,) `Overlap.covered`.
        up: (3,) direction away from the table.
    """
    bounds = limits or WoundLimits()
    lacking = _close_mask(ct.vertices_m, ~covered, bounds.closing_m)
    labels = components(ct, lacking)
    wound = np.zeros(len(lacking), dtype=np.bool_)
    if not lacking.any():
        return wound
    height = ct.vertices_m @ (up / np.linalg.norm(up))
    size, facing = ct.sums_at_vertices(lambda faces: _size_and_facing(ct, faces, up)).T
    rim = np.zeros(len(lacking), dtype=np.bool_)
    crossing = ct.touching(lacking) & ct.touching(~lacking)
    rim[ct.faces[crossing].ravel()] = True
    rim &= lacking
    n = int(labels.max()) + 1
    which = labels[lacking]
    area = np.bincount(which, size[lacking], n)
    level = np.bincount(which, (size * height)[lacking], n) / np.maximum(area, 1e-300)
    on_rim = np.bincount(labels[rim], minlength=n)
    edge = np.bincount(labels[rim], height[rim], n) / np.maximum(on_rim, 1)
    hollow = (area >= bounds.least_area_m2) & (edge - level >= bounds.least_depth_m) & (on_rim > 0)
    hollow &= np.bincount(which, facing[lacking], n) >= bounds.least_facing * area
    wound[lacking] = hollow[which]
    return wound


def _size_and_facing(surface: Surface, faces: slice, up: Array) -> Array:
    """Return (N, 2) a third of the area of some faces, and of that area as seen from above: each corner's part."""
    vectors = surface.area_vectors_of(faces) / 3
    return np.stack([np.linalg.norm(vectors, axis=1), vectors @ (up / np.linalg.norm(up))], axis=1)


def components(surface: Surface, chosen: Mask) -> IntArray:
    """Return (V,) number of the connected part that each chosen vertex is in; -1 for the others."""
    index = np.full(len(chosen), -1, dtype=np.int32)
    n = int(chosen.sum())
    index[chosen] = np.arange(n)
    ends: list[tuple[NDArray[np.int32], NDArray[np.int32]]] = [(np.zeros(0, np.int32), np.zeros(0, np.int32))]
    for begin in range(0, len(surface.faces), _FACES):
        ends.append(_spanning(index[surface.faces[begin : begin + _FACES]], n))
    a, b = (np.concatenate(parts) for parts in zip(*ends, strict=True))
    graph = coo_matrix((np.ones(len(a)), (a, b)), shape=(n, n))
    out = np.full(len(chosen), -1, dtype=np.int64)
    out[chosen] = connected_components(graph, directed=False)[1]
    return out


def _spanning(faces: NDArray[np.int32], n: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return pairs of vertices (K,), (K,) that connect what these faces (N, 3) connect, fewer than the edges.

    Vertices of number -1 are left out; the others have numbers below n.
    """
    one, other, third = faces.T
    apart = np.flatnonzero(other < 0)  # where the second corner is left out, nothing else connects the two others
    a, b = np.concatenate([one, other, third[apart]]), np.concatenate([other, third, one[apart]])
    both = (a >= 0) & (b >= 0)
    a, b = a[both], b[both]
    used = np.zeros(n, dtype=np.bool_)
    used[a] = used[b] = True
    there = np.flatnonzero(used).astype(np.int32)
    number = np.empty(n, dtype=np.int32)
    number[there] = np.arange(len(there), dtype=np.int32)
    graph = coo_matrix((np.ones(len(a)), (number[a], number[b])), shape=(len(there), len(there)))
    label = connected_components(graph, directed=False)[1]
    first = np.full(int(label.max(initial=-1)) + 1, -1, dtype=np.int32)
    first[label[::-1]] = there[::-1]
    return there, first[label]


def rim_vertices(surface: Surface) -> IntArray:
    """Return (K,) vertices on edges that only one face has."""
    f, n = surface.faces, len(surface.vertices_m)
    ends = np.sort(np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]]).astype(np.int64), axis=1)
    keys, counts = np.unique(ends[:, 0] * n + ends[:, 1], return_counts=True)
    alone = keys[counts == 1]
    return np.unique(np.concatenate([alone // n, alone % n]))


def distance_to(points: Array, chosen: Mask, within_m: float) -> Array:
    """Return (N,) distance from points (N, 3) to the nearest chosen one; infinite beyond `within_m`."""
    distance = np.where(chosen, 0.0, np.inf)
    if chosen.any():
        distance[~chosen] = PointIndex(points[chosen]).nearest(points[~chosen], within_m)[0]
    return distance


def _close_mask(points: Array, chosen: Mask, radius: float) -> Mask:
    """Grow and shrink a mask by a radius, so that gaps and islands between chosen points are chosen, too."""
    grown = distance_to(points, chosen, radius) <= radius
    return chosen | (distance_to(points, ~grown, radius) > radius)


def _longest_edge(surface: Surface) -> float:
    if not surface.is_mesh:
        raise ComputeError("fusion needs meshes, not point clouds", remedy="Export the scan with faces")
    longest = 0.0
    for block in surface.blocks():
        p = surface.vertices_m[surface.faces[block]]
        longest = max(longest, float(np.max(np.sum((p - np.roll(p, 1, axis=1)) ** 2, axis=2))))
    return float(np.sqrt(longest))


class Region(Protocol):
    """A part of space."""

    def contains(self, points_m: Array) -> Mask:
        """Return (N,) which points (N, 3) lie inside."""
        ...


@dataclass(frozen=True, slots=True)
class Box:
    """A box of edges `size_m` (3,), centred at the origin of `T_world_box`."""

    T_world_box: Transform = field(repr=False)
    size_m: Array

    def contains(self, points_m: Array) -> Mask:
        """Return (N,) which points (N, 3) lie inside or on the faces."""
        return np.all(np.abs(apply(inverse(self.T_world_box), points_m)) <= 0.5 * self.size_m, axis=1)


@dataclass(frozen=True, slots=True)
class Prism:
    """A polygon (K, 2) in the x-y plane of `T_world_plane`, extended by depths (low, high) along that plane's z."""

    T_world_plane: Transform = field(repr=False)
    polygon_m: Array
    depth_m: tuple[float, float]

    def __post_init__(self) -> None:
        if self.polygon_m.ndim != 2 or self.polygon_m.shape[1] != 2 or len(self.polygon_m) < 3:
            raise DataError("a polygon needs at least three corners (x, y)", remedy="Draw it again")

    def contains(self, points_m: Array) -> Mask:
        """Return (N,) which points (N, 3) lie inside, by the parity of the edges that a line from each crosses."""
        p = apply(inverse(self.T_world_plane), points_m)
        inside = np.zeros(len(p), dtype=np.bool_)
        for a, b in zip(self.polygon_m, np.roll(self.polygon_m, -1, axis=0), strict=True):
            if a[1] == b[1]:
                continue
            beside = (p[:, 1] >= min(a[1], b[1])) & (p[:, 1] < max(a[1], b[1]))
            inside ^= beside & (p[:, 0] < a[0] + (p[:, 1] - a[1]) / (b[1] - a[1]) * (b[0] - a[0]))
        return inside & (p[:, 2] >= self.depth_m[0]) & (p[:, 2] <= self.depth_m[1])


@dataclass(frozen=True, slots=True)
class SphereRegion:
    """The points within a radius of any of the centres (M, 3), such as those of spheres that were taken away."""

    centres_m: Array
    radius_m: float

    def contains(self, points_m: Array) -> Mask:
        """Return (N,) which points (N, 3) lie in it."""
        out = np.zeros(len(points_m), dtype=np.bool_)
        for centre in self.centres_m:
            beside = np.flatnonzero(np.abs(points_m[:, 0] - centre[0]) <= 1.001 * self.radius_m)  # few are
            out[beside] |= np.linalg.norm(points_m[beside] - centre, axis=1) <= self.radius_m
        return out


@dataclass(frozen=True, slots=True)
class RegionCorrection:
    """A region in which a person has chosen CT or scan.

    Attributes:
        region: the region.
        from_ct: True: the CT is taken there; False: the scan, wherever it has surface.
        by: the person who drew it.
    """

    region: Region
    from_ct: bool
    by: str


def corrected(proposed: Mask, points_m: Array, corrections: Sequence[RegionCorrection]) -> Mask:
    """Return (N,) the mask after the corrections, of which a later one overrules an earlier one."""
    out = proposed.copy()
    for correction in corrections:
        out[correction.region.contains(points_m)] = correction.from_ct
    return out


def seen_along(corners_m: Array, along: Array, depth_m: tuple[float, float]) -> Prism:
    """Build the prism over a polygon with corners (K, 3) in space, as seen along a direction (3,), extended along it.

    Args:
        corners_m: (K, 3) corners in order around the polygon.
        along: (3,) direction from the surface towards the viewer.
        depth_m: distances by which it reaches below the lowest corner (negative) and above the highest one.

    Raises:
        DataError: fewer than three corners, or no direction.
    """
    if len(corners_m) < 3 or not np.linalg.norm(along) > 0:
        raise DataError("a polygon needs at least three corners and a direction", remedy="Draw it again")
    T = _plane(along)
    T[:3, 3] = corners_m.mean(axis=0)
    p = apply(inverse(T), corners_m)
    return Prism(T, p[:, :2], (float(p[:, 2].min()) + depth_m[0], float(p[:, 2].max()) + depth_m[1]))


def outline(points_m: Array, up: Array) -> Prism:
    """Return the smallest convex prism along `up` (3,) that holds points (N, 3): a polygon to start drawing with."""
    T = _plane(up)
    T[:3, 3] = points_m.mean(axis=0)
    p = apply(inverse(T), points_m)
    hull = cv2.convexHull(p[:, :2].astype(np.float32)).reshape(-1, 2).astype(np.float64)
    return Prism(T, hull, (float(p[:, 2].min()), float(p[:, 2].max())))


def _plane(direction: Array) -> Transform:
    """Return (4, 4) rotation whose z is this direction (3,)."""
    z = direction / np.linalg.norm(direction)
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    return T
