"""Regions of space that a person draws to correct the proposed wound: boxes, and polygons seen along a direction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from service.core.errors import DataError
from service.core.geometry import Array, Transform, apply, inverse

Mask = NDArray[np.bool_]


class Region(Protocol):
    """A part of space."""

    def contains(self, points_m: Array) -> Mask:
        """(N,) which points (N, 3) lie inside."""
        ...


@dataclass(frozen=True, slots=True)
class Box:
    """A box of edges `size_m` (3,), centred at the origin of `T_world_box`."""

    T_world_box: Transform = field(repr=False)
    size_m: Array

    def contains(self, points_m: Array) -> Mask:
        """(N,) which points (N, 3) lie inside or on the faces."""
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
        """(N,) which points (N, 3) lie inside; by the parity of the polygon's edges that a line from each crosses."""
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
        """(N,) which points (N, 3) lie in it."""
        out = np.zeros(len(points_m), dtype=np.bool_)
        for centre in self.centres_m:
            beside = np.flatnonzero(np.abs(points_m[:, 0] - centre[0]) <= 1.001 * self.radius_m)  # few are
            out[beside] |= np.linalg.norm(points_m[beside] - centre, axis=1) <= self.radius_m
        return out


@dataclass(frozen=True, slots=True)
class RegionCorrection:
    """A region in which a person has chosen CT or scan.

    Attributes:
        region: where.
        from_ct: True: the CT is taken there; False: the scan, wherever it has surface.
        by: who drew it.
    """

    region: Region
    from_ct: bool
    by: str


def corrected(proposed: Mask, points_m: Array, corrections: Sequence[RegionCorrection]) -> Mask:
    """(N,) the mask after the corrections, of which a later one overrules an earlier one."""
    out = proposed.copy()
    for correction in corrections:
        out[correction.region.contains(points_m)] = correction.from_ct
    return out


def seen_along(corners_m: Array, along: Array, depth_m: tuple[float, float]) -> Prism:
    """A polygon with corners (K, 3) in space, as seen along a direction (3,), extended along it.

    Args:
        corners_m: in order around the polygon.
        along: from the surface towards the viewer.
        depth_m: how far it reaches below the lowest corner (negative) and above the highest one.

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
    """The smallest convex prism along `up` (3,) that holds these points (N, 3): a polygon to begin drawing with."""
    T = _plane(up)
    T[:3, 3] = points_m.mean(axis=0)
    p = apply(inverse(T), points_m)
    hull = cv2.convexHull(p[:, :2].astype(np.float32)).reshape(-1, 2).astype(np.float64)
    return Prism(T, hull, (float(p[:, 2].min()), float(p[:, 2].max())))


def _plane(direction: Array) -> Transform:
    """(4, 4) rotation whose z is this direction (3,)."""
    z = direction / np.linalg.norm(direction)
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    return T
