"""Cuts polygons into triangles without leaving their outline: concave ones too, and those not quite flat."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import Array

IntArray = NDArray[np.int64]
_ALIKE = 1e-6  # of a length: diagonals that differ by less are equally long
_FLAT = 1e-12  # of a polygon's area: what is smaller is no area, but the rounding of coordinates


@dataclass(frozen=True, slots=True)
class Triangles:
    """Holds what polygons were cut into.

    Attributes:
        at: (F, 3) places in the list of corners, in the order of the polygons and of their winding.
        doubtful: the number of polygons that have no inside to speak of: fewer than three corners (left out), no
            area, or a crossing of their own outline (both cut from one corner, as most programs do).
    """

    at: IntArray
    doubtful: int


def in_doubt(doubtful: int) -> str:
    """Words for polygons that have no inside to speak of; empty if there are none."""
    if not doubtful:
        return ""
    return (
        f"{doubtful} of its polygons have fewer than three corners (left out), no area, or an outline that crosses "
        "itself (cut from one corner)"
    )


def cut(vertices: Array, corners: IntArray, counts: IntArray) -> Triangles:
    """Cut polygons into triangles; a polygon of n corners becomes n - 2.

    The result does not depend on the corner at which a polygon begins.

    Args:
        vertices: (V, 3).
        corners: (C,) indices of vertices, polygon after polygon.
        counts: (P,) corners of each polygon.
    """
    first = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64)
    parts = np.maximum(counts - 2, 0)
    place = np.concatenate([[0], np.cumsum(parts)[:-1]]).astype(np.int64)
    at = np.empty((int(parts.sum()), 3), dtype=np.int64)
    doubtful = int(np.count_nonzero(parts == 0))
    for n in np.unique(counts[counts > 2]).tolist():
        polygons = np.flatnonzero(counts == n)
        if n == 3:
            local = np.broadcast_to(np.arange(3), (len(polygons), 1, 3))
        else:
            points = vertices[corners[first[polygons, None] + np.arange(n)]]
            with np.errstate(invalid="ignore", over="ignore"):  # coordinates may not be finite; it is said elsewhere
                local, wrong = _quadrangles(points) if n == 4 else _polygons(points)
            doubtful += wrong
        at[place[polygons, None] + np.arange(n - 2)] = first[polygons, None, None] + local
    return Triangles(at, doubtful)


def _quadrangles(p: Array) -> tuple[IntArray, int]:
    """Cut quadrangles (Q, 4, 3) along the shorter diagonal, or along the only one that lies inside."""
    splits = np.array([[[0, 1, 2], [0, 2, 3]], [[1, 2, 3], [1, 3, 0]]])
    x, y, z = np.ascontiguousarray(p.transpose(2, 1, 0))  # each (4, Q): far faster than np.cross on rows

    def doubled_area(i: int, j: int, k: int, m: int) -> tuple[Array, Array, Array]:
        """The cross product of the lines from corner i to j and from k to m."""
        (ax, bx), (ay, by), (az, bz) = ((c[j] - c[i], c[m] - c[k]) for c in (x, y, z))
        return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx

    normal = doubled_area(0, 2, 1, 3)
    size = _dot(normal, normal)
    least = np.empty((len(p), 2))  # of the shares of the area that the two triangles of each split have
    for k, split in enumerate(splits.tolist()):
        shares = [_dot(doubled_area(i, j, i, m), normal) for i, j, m in split]
        least[:, k] = np.minimum(*shares)
    inside = least > 1e-9 * size[:, None]
    lines = [(x[j] - x[i], y[j] - y[i], z[j] - z[i]) for i, j in ((0, 2), (1, 3))]
    diagonal = np.stack([_dot(line, line) for line in lines], axis=1)
    shorter = np.argmin(diagonal, axis=1)
    alike = np.flatnonzero(np.abs(diagonal[:, 0] - diagonal[:, 1]) <= _ALIKE * diagonal.max(axis=1))
    shorter[alike] = _lowest(p[alike]) % 2
    chosen = np.where(inside[:, 0] == inside[:, 1], shorter, np.argmax(inside, axis=1))
    # A corner given twice, or one between collinear edges, leaves a triangle without an area, and no doubt.
    chosen = np.where(inside.any(axis=1), chosen, np.argmax(least, axis=1))
    doubtful = ~((size > 0) & (least >= -1e-9 * size[:, None]).any(axis=1))
    return splits[np.where(doubtful, 0, chosen)], int(np.count_nonzero(doubtful))


def _dot(a: tuple[Array, Array, Array], b: tuple[Array, Array, Array]) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _polygons(p: Array) -> tuple[IntArray, int]:
    """Cut polygons (G, n, 3), n > 4: convex ones as a fan from their lowest corner, others by clipping ears."""
    groups, n = p.shape[:2]
    start = _lowest(p)
    turned = (start[:, None] + np.arange(n)) % n
    flat = _in_own_plane(np.take_along_axis(p, turned[..., None], axis=1))
    turn, once = _turns(flat)
    convex = once & (turn > 1e-9 * np.abs(turn).max(axis=1, keepdims=True)).all(axis=1)
    fan = np.stack([np.zeros(n - 2), np.arange(1, n - 1), np.arange(2, n)], axis=1).astype(np.int64)
    local = np.broadcast_to(fan, (groups, n - 2, 3)).copy()
    doubtful = 0
    for g in np.flatnonzero(~convex):
        found = _ears(flat[g])
        if found is None:
            doubtful += 1
        else:
            local[g] = found
    return np.take_along_axis(turned[:, None, :], local.reshape(groups, 1, -1), axis=2).reshape(local.shape), doubtful


def _turns(flat: Array) -> tuple[Array, NDArray[np.bool_]]:
    """The sines of the turns at the corners of polygons (G, n, 2), times both edges, and whether they turn once."""
    edge, following = flat - np.roll(flat, 1, axis=1), np.roll(flat, -1, axis=1) - flat
    turn = edge[..., 0] * following[..., 1] - edge[..., 1] * following[..., 0]
    angle = np.arctan2(turn, np.einsum("gij,gij->gi", edge, following))
    return turn, np.abs(angle.sum(axis=1) - 2 * np.pi) < 1e-3  # a star turns more often, an eight not at all


def _lowest(p: Array) -> IntArray:
    """The corner of each polygon (G, n, 3) with the least x, of these with the least y, then z, (G,)."""
    groups, n = p.shape[:2]
    rank = np.empty(groups * n, dtype=np.int64)
    rank[np.lexsort(p.reshape(-1, 3).T[::-1])] = np.arange(groups * n)
    return rank.reshape(groups, n).argmin(axis=1)


def _in_own_plane(p: Array) -> Array:
    """Polygons (G, n, 3) seen along their area vector (Newell's normal), anticlockwise, (G, n, 2)."""
    p = p - p.mean(axis=1, keepdims=True)
    normal = np.cross(p, np.roll(p, -1, axis=1)).sum(axis=1)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / np.where(length > 0, length, 1)
    aside = np.eye(3)[np.abs(normal).argmin(axis=1)]
    x = np.cross(aside, normal)
    x /= np.where(length > 0, np.linalg.norm(x, axis=1, keepdims=True), 1)
    y = np.cross(normal, x)
    return np.stack([np.einsum("gij,gj->gi", p, x), np.einsum("gij,gj->gi", p, y)], axis=2)


def _ears(flat: Array) -> IntArray | None:
    """Clip the ears of one polygon (n, 2) that winds anticlockwise, (n - 2, 3); None if it crosses itself.

    An ear is a corner whose triangle lies inside. Corners between collinear edges are no ears while others are left.
    """
    n = len(flat)
    x, y = flat[:, 0], flat[:, 1]
    again = (flat == np.roll(flat, 1, axis=0)).all(axis=1)  # a corner that is given twice in a row
    least = _FLAT * float(np.ptp(x) ** 2 + np.ptp(y) ** 2)
    if not least > 0 or not _turns(flat[None, ~again])[1][0]:
        return None

    def doubled_area(a: int, b: int, c: int) -> float:
        return float((x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a]))

    def is_ear(a: int, b: int, c: int) -> bool:
        if not doubled_area(a, b, c) > least:
            return False
        others = np.array([i for i in left if i not in (a, b, c)], dtype=np.int64)
        inside = np.ones(len(others), dtype=np.bool_)
        for i, j in ((a, b), (b, c), (c, a)):
            inside &= (x[j] - x[i]) * (y[others] - y[i]) - (y[j] - y[i]) * (x[others] - x[i]) >= -least
            # A hole is joined to the outline by an edge that is passed twice: its ends come twice too.
            inside &= (x[others] != x[i]) | (y[others] != y[i])
        return not inside.any()

    found = [((i - 1) % n, i, (i + 1) % n) for i in np.flatnonzero(again).tolist()]
    left: list[int] = np.flatnonzero(~again).tolist()
    at, tried = 0, 0
    while len(left) > 3:
        a, b, c = (left[(at + k) % len(left)] for k in (-1, 0, 1))
        if is_ear(a, b, c) or (tried >= len(left) and abs(doubled_area(a, b, c)) <= least):
            found.append((a, b, c))
            left.remove(b)
            tried = 0
        elif (tried := tried + 1) > 2 * len(left):
            return None
        at = (at + 1) % len(left)  # the corner after a clipped ear is passed over: fewer slivers
    found.append((left[0], left[1], left[2]))
    return np.array(found, dtype=np.int64) if doubled_area(*found[-1]) >= -least else None
