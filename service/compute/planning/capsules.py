"""Distances between capsules, boxes and the table, for many configurations at once."""

from __future__ import annotations

import numpy as np

from service.core.geometry import Array

_TINY = 1e-15


def segment_distance_m(p0: Array, p1: Array, q0: Array, q1: Array) -> Array:
    """Least distance (...,) between segments p0–p1 and q0–q1, all (..., 3), broadcast; a segment may be a point.

    Source: C. Ericson, Real-Time Collision Detection, 2005, section 5.1.9.
    """
    d1, d2, r = p1 - p0, q1 - q0, p0 - q0
    a, e, f = _dot(d1, d1), _dot(d2, d2), _dot(d2, r)
    b, c = _dot(d1, d2), _dot(d1, r)
    denominator = a * e - b * b
    with np.errstate(divide="ignore", invalid="ignore"):
        s = np.where(denominator > 1e-12 * a * e, (b * f - c * e) / denominator, 0.0)
        s = np.where(a > _TINY, np.clip(s, 0.0, 1.0), 0.0)
        t = np.where(e > _TINY, (b * s + f) / np.where(e > _TINY, e, 1.0), 0.0)
        # If t is outside its segment, it is clamped, and s is recomputed.
        clamped = np.clip(t, 0.0, 1.0)
        s = np.where(a > _TINY, np.clip((b * clamped - c) / np.where(a > _TINY, a, 1.0), 0.0, 1.0), 0.0)
    gap = r + s[..., None] * d1 - clamped[..., None] * d2
    return np.sqrt(_dot(gap, gap))


def segment_box_distance_m(p0: Array, p1: Array, half_extent_m: Array) -> Array:
    """Least distance (...,) of segments p0–p1 (..., 3) to the box of ± half extents (3,) at the origin; 0 inside.

    The distance to a convex body is convex along a segment, so ternary search finds its minimum, to a micrometre on
    segments of a metre.
    """
    low, high = (
        np.zeros(np.broadcast_shapes(p0.shape, p1.shape)[:-1]),
        np.ones(np.broadcast_shapes(p0.shape, p1.shape)[:-1]),
    )
    for _ in range(36):
        third = (high - low) / 3
        left, right = low + third, high - third
        nearer_left = _box(p0 + left[..., None] * (p1 - p0), half_extent_m) <= _box(
            p0 + right[..., None] * (p1 - p0), half_extent_m
        )
        high = np.where(nearer_left, right, high)
        low = np.where(nearer_left, low, left)
    middle = 0.5 * (low + high)
    return _box(p0 + middle[..., None] * (p1 - p0), half_extent_m)


def _box(points: Array, half_extent_m: Array) -> Array:
    outside = np.maximum(np.abs(points) - half_extent_m, 0.0)
    return np.sqrt(_dot(outside, outside))


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("...i,...i->...", a, b), dtype=np.float64)
