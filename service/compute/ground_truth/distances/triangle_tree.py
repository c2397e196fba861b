"""Exact distances from points to a triangle mesh, by a tree of bounding boxes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from service.compute.ground_truth.distances.neighbours import z_order
from service.compute.ground_truth.surface import IntArray, Surface
from service.core.geometry import Array

_LEAF = 4  # faces in a leaf
_LEAVES = 200_000  # made at a time
_QUERIES = 20_000  # at a time, which limits the memory
_PAIRS = 1_000_000  # of a query and a face, compared at a time


@dataclass(frozen=True, slots=True)
class NearestPoints:
    """The places on a mesh that are nearest to some points: distance (Q,), place (Q, 3), face (Q,)."""

    distance_m: Array = field(repr=False)
    points_m: Array = field(repr=False)
    faces: IntArray = field(repr=False)


class TriangleTree:
    """The faces of a mesh, in which the nearest place of the surface to any point is found exactly."""

    def __init__(self, surface: Surface) -> None:
        faces, self._vertices = surface.faces, surface.vertices_m
        middles = np.empty((len(faces), 3))
        for block in surface.blocks():
            middles[block] = self._vertices[faces[block]].mean(axis=1)
        self._order = z_order(middles)
        del middles
        self._faces = faces[self._order]
        low, high = (np.empty((-(-len(faces) // _LEAF), 3)) for _ in range(2))
        for begin in range(0, len(low), _LEAVES):
            corners = self._vertices[self._faces[_LEAF * begin : _LEAF * (begin + _LEAVES)]]
            leaves = np.arange(0, len(corners), _LEAF)
            low[begin : begin + _LEAVES] = np.minimum.reduceat(corners.min(axis=1), leaves, axis=0)
            high[begin : begin + _LEAVES] = np.maximum.reduceat(corners.max(axis=1), leaves, axis=0)
        self._levels = [(low, high)]  # from the leaves to the root; two boxes have one parent
        while len(low) > 1:
            pairs = np.arange(0, len(low), 2)
            low, high = np.minimum.reduceat(low, pairs, axis=0), np.maximum.reduceat(high, pairs, axis=0)
            self._levels.append((low, high))

    def nearest(self, queries_m: Array, bounds_m: Array | None = None) -> NearestPoints:
        """Find the point of the surface nearest to each query (Q, 3).

        Args:
            queries_m: (Q, 3).
            bounds_m: (Q,) distances from each query to some place of the surface, such as a sample of it. The
                closer these are to the answer, the faster it is found; None: found by descending the tree.
        """
        out = NearestPoints(
            np.empty(len(queries_m)), np.empty((len(queries_m), 3)), np.empty(len(queries_m), dtype=np.int64)
        )
        for begin in range(0, len(queries_m), _QUERIES):
            part = slice(begin, begin + _QUERIES)
            queries = queries_m[part]
            bounds = self._descended(queries) if bounds_m is None else bounds_m[part]
            query, leaf = self._candidates(queries, bounds * (1 + 1e-9) + 1e-12)
            d, p, f = self._closest(queries, query, leaf)
            out.distance_m[part], out.points_m[part], out.faces[part] = d, p, self._order[f]
        return out

    def _descended(self, queries: Array) -> Array:
        """(Q,) distance to a face that is found by always taking the nearer box."""
        at = np.zeros(len(queries), dtype=np.int64)
        for low, high in self._levels[-2::-1]:
            left, right = 2 * at, np.minimum(2 * at + 1, len(low) - 1)
            nearer = _box_distance(queries, low[right], high[right]) < _box_distance(queries, low[left], high[left])
            at = np.where(nearer, right, left)
        return self._closest(queries, np.arange(len(queries)), at)[0]

    def _candidates(self, queries: Array, bounds: Array) -> tuple[IntArray, IntArray]:
        """All pairs of a query and a leaf whose box is within the query's bound, sorted by query."""
        query = np.arange(len(queries))
        node = np.zeros(len(queries), dtype=np.int64)
        for low, high in self._levels[-2::-1]:
            query, node = np.repeat(query, 2), np.repeat(2 * node, 2)
            node[1::2] += 1
            there = node < len(low)
            query, node = query[there], node[there]
            near = _box_distance(queries[query], low[node], high[node]) <= bounds[query]
            query, node = query[near], node[near]
        return query, node

    def _closest(self, queries: Array, query: IntArray, leaf: IntArray) -> tuple[Array, Array, IntArray]:
        """Find the face of these leaves that is nearest to each query. Returns distance, nearest point and face."""
        distance = np.full(len(queries), np.inf)
        place, face = np.empty((len(queries), 3)), np.zeros(len(queries), dtype=np.int64)
        step = _PAIRS // _LEAF
        for begin in range(0, len(query), step):
            which = np.repeat(query[begin : begin + step], _LEAF)
            faces = (leaf[begin : begin + step, None] * _LEAF + np.arange(_LEAF)).ravel()
            there = faces < len(self._faces)
            which, faces = which[there], faces[there]
            p = closest_on_triangles(queries[which], self._vertices[self._faces[faces]])
            d = np.linalg.norm(p - queries[which], axis=1)
            best = np.lexsort((d, which))
            best = best[np.flatnonzero(np.diff(which[best], prepend=-1))]
            better = best[d[best] < distance[which[best]]]
            at = which[better]
            distance[at], place[at], face[at] = d[better], p[better], faces[better]
        return distance, place, face


def _box_distance(points: Array, low: Array, high: Array) -> Array:
    """(N,) distance from points (N, 3) to boxes with these corners (N, 3)."""
    return np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0.0), axis=1)


def closest_on_triangles(points: Array, corners: Array) -> Array:
    """(N, 3) the place of each triangle (N, 3, 3) that is nearest to its point (N, 3).

    Source: Ericson, Real-Time Collision Detection, 2005, section 5.1.5, on arrays.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, ac = b - a, c - a
    d1, d2 = _dot(ab, points - a), _dot(ac, points - a)
    d3, d4 = _dot(ab, points - b), _dot(ac, points - b)
    d5, d6 = _dot(ab, points - c), _dot(ac, points - c)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    whole = va + vb + vc
    solid = np.abs(whole) > 0
    scale = 1 / np.where(solid, whole, 1.0)
    v, w = vb * scale, vc * scale
    on_ab = (vc <= 0) & (d1 >= 0) & (d3 <= 0)
    on_ac = (vb <= 0) & (d2 >= 0) & (d6 <= 0)
    on_bc = (va <= 0) & (d4 - d3 >= 0) & (d5 - d6 >= 0)
    t = _ratio(d4 - d3, (d4 - d3) + (d5 - d6))
    v, w = np.where(on_bc, 1 - t, v), np.where(on_bc, t, w)
    v, w = np.where(on_ac, 0.0, v), np.where(on_ac, _ratio(d2, d2 - d6), w)
    v, w = np.where(on_ab, _ratio(d1, d1 - d3), v), np.where(on_ab, 0.0, w)
    at_c, at_b, at_a = (d6 >= 0) & (d5 <= d6), (d3 >= 0) & (d4 <= d3), (d1 <= 0) & (d2 <= 0)
    v, w = np.where(at_c, 0.0, v), np.where(at_c, 1.0, w)
    v, w = np.where(at_b, 1.0, v), np.where(at_b, 0.0, w)
    v, w = np.where(at_a, 0.0, v), np.where(at_a, 0.0, w)
    return np.stack([a[:, k] + v * ab[:, k] + w * ac[:, k] for k in range(3)], axis=1)


def _dot(a: Array, b: Array) -> Array:
    return np.einsum("ni,ni->n", a, b)


def _ratio(a: Array, b: Array) -> Array:
    return np.clip(a / np.where(b == 0, 1.0, b), 0.0, 1.0)
