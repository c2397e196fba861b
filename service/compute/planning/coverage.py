"""Coverage of the specimen's surface by images: sample points, and ray casting against the CT's surface.

Coverage is relative to the surface visible from a dome of directions above: surfaces inside, underneath or in folds
that no camera reaches do not count as missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, cast

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from trimesh.ray.ray_pyembree import RayMeshIntersector

from service.compute.camera_model import CameraModel
from service.compute.surfaces.chamfer import random_places
from service.compute.surfaces.surface import IntArray, Surface
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, apply, inverse

_CELL_M = 0.0025  # of the simplified occluder
_LIFT_M = 0.002  # of points above the simplified surface, so that it does not occlude its own points
_BOARD_M = 0.004  # thickness of the layer that counts as the board
_CLEAR_OF_SPHERES = 1.4  # radii
_DOME_TILTS_DEG = (0.0, 20.0, 40.0, 55.0)
_MARGIN_M = 0.08  # margin of surface left around the spheres


@dataclass(frozen=True, slots=True)
class CoverageLimits:
    """Conditions for a view of a point to count."""

    max_angle_deg: float = 65.0  # between the surface's normal and the direction to the camera
    max_distance_m: float = 1.0
    min_views: int = 2


@dataclass(frozen=True)
class CoverageSurface:
    """Points of the specimen with outward normals, and the surface that may occlude them; in the scan frame."""

    points_m: Array = field(repr=False)  # (N, 3)
    normals: Array = field(repr=False)  # (N, 3)
    occluder_vertices_m: Array = field(repr=False)
    occluder_faces: NDArray[np.int64] = field(repr=False)

    @cached_property
    def rays(self) -> Any:
        """The ray caster of the occluder; None if there is none."""
        if len(self.occluder_faces) == 0:
            return None
        return RayMeshIntersector(trimesh.Trimesh(self.occluder_vertices_m, self.occluder_faces, process=False))

    def free(self, origins: Array, target: Array) -> NDArray[np.bool_]:
        """Return (K,) whether the line from origins (K, 3) to `target` (3,) or targets (K, 3) is unobstructed."""
        if self.rays is None or len(origins) == 0:
            return np.ones(len(origins), dtype=bool)
        return ~np.asarray(self.rays.intersects_any(origins, target - origins), dtype=bool)


def coverage_surface(
    vertices_m: Array,
    faces: NDArray[np.int32],
    spheres_m: Array,
    radius_m: float,
    limits: CoverageLimits,
    *,
    n_points: int = 3000,
    seed: int = 0,
) -> CoverageSurface:
    """Sample the part of the specimen's surface that is visible from above.

    Args:
        vertices_m, faces: surface of the scene (V, 3), (F, 3) with outward winding, including spheres and board.
        spheres_m: (M, 3) around the specimen, which lies within their hull as seen from above.

    Raises:
        ComputeError: there is no surface between the spheres.
    """
    centre = spheres_m.mean(axis=0)
    low, high = spheres_m.min(axis=0) - _MARGIN_M, spheres_m.max(axis=0) + _MARGIN_M
    near = np.all((vertices_m > low) & (vertices_m < high), axis=1)
    surface = Surface(vertices_m, cast("IntArray", faces[_all_near(near, faces)]))  # the integers stay short
    if len(surface.faces) < 100:
        raise ComputeError("the surface does not reach the spheres", remedy="Check the frame and unit of the mesh")
    up = _up(spheres_m, surface)
    rng = np.random.default_rng(seed)
    doubled = 2 * surface.face_areas_m2
    picked = rng.choice(len(doubled), size=40 * n_points, p=doubled / doubled.sum())
    points = random_places(surface, picked, rng)
    normals = surface.normals_of(picked)
    keep = _between(points, spheres_m, radius_m, up) & ~_on_board(points, normals, up, centre) & (normals @ up > -0.5)
    points, normals = points[keep][: 2 * n_points], normals[keep][: 2 * n_points]
    vertices, simple = _simplified(surface)
    whole = CoverageSurface(points, normals, vertices, simple)
    visible = np.zeros(len(points), dtype=bool)
    reach = min(0.65, 0.9 * limits.max_distance_m)
    for eye in _dome(centre, up, reach):
        visible |= seen(whole, eye, limits)
    if visible.sum() < 50:
        raise ComputeError("between the spheres there is no surface that can be seen from above")
    chosen = np.nonzero(visible)[0][:n_points]
    return CoverageSurface(points[chosen], normals[chosen], vertices, simple)


def seen(
    surface: CoverageSurface,
    eye_m: Array,
    limits: CoverageLimits,
    T_scan_camera: Transform | None = None,
    camera: CameraModel | None = None,
) -> NDArray[np.bool_]:
    """Return (N,) points that a camera at `eye_m` (3,) sees at a good angle; with a camera, those in its image."""
    way = eye_m - surface.points_m
    distance = np.linalg.norm(way, axis=1)
    facing = np.einsum("ni,ni->n", way, surface.normals) / distance
    good = (facing >= np.cos(np.radians(limits.max_angle_deg))) & (distance <= limits.max_distance_m)
    if camera is not None and T_scan_camera is not None:
        inside = apply(inverse(T_scan_camera), surface.points_m)
        ahead = inside[:, 2] > 0.05
        pixels = np.full((len(inside), 2), -1.0)
        pixels[ahead] = camera.project(inside[ahead])
        good &= ahead & np.all((pixels >= 0) & (pixels <= [camera.width - 1, camera.height - 1]), axis=1)
    index = np.nonzero(good)[0]
    good[index] = surface.free(surface.points_m[index] + _LIFT_M * surface.normals[index], eye_m)
    return good


def covered_fraction(views: Sequence[NDArray[np.bool_]], min_views: int) -> float:
    """Return the share of the points seen in at least `min_views` of the views (N,); 0 without views."""
    if not views:
        return 0.0
    return float(np.mean(np.sum(views, axis=0) >= min_views))


def _all_near(near: NDArray[np.bool_], faces: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Return (F,) whether all corners of a face are near."""
    return near[faces[:, 0]] & near[faces[:, 1]] & near[faces[:, 2]]


def _up(spheres_m: Array, surface: Surface) -> Array:
    """Return the unit vector (3,) away from the spheres' board: most of the surface around them is the board's."""
    normal = np.linalg.svd(spheres_m - spheres_m.mean(axis=0))[2][2]
    total = np.zeros(3)
    for block in surface.blocks():
        middles = surface.vertices_m[surface.faces[block]].mean(axis=1)
        total += surface.face_areas_m2[block] @ middles
    below = (total / surface.area_m2 - spheres_m.mean(axis=0)) @ normal
    return np.asarray(normal if below < 0 else -normal, dtype=np.float64)


def _plane_axes(up: Array) -> Array:
    e1 = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0])
    e1 /= np.linalg.norm(e1)
    return np.stack([e1, np.cross(up, e1)])


def _between(points: Array, spheres_m: Array, radius_m: float, up: Array) -> NDArray[np.bool_]:
    """Return the points within the hull of the spheres as seen from above, and not on a sphere or its post."""
    axes = _plane_axes(up)
    flat, feet = points @ axes.T, spheres_m @ axes.T
    hull = ConvexHull(feet)
    inside = np.all(flat @ hull.equations[:, :2].T + hull.equations[:, 2] <= 0, axis=1)
    for sphere, foot in zip(spheres_m, feet, strict=True):
        inside &= np.linalg.norm(points - sphere, axis=1) > _CLEAR_OF_SPHERES * radius_m
        below = (np.linalg.norm(flat - foot, axis=1) < radius_m) & ((points - sphere) @ up < 0)
        inside &= ~below
    return inside


def _on_board(points: Array, normals: Array, up: Array, centre: Array) -> NDArray[np.bool_]:
    """Return the points on the plane under the specimen, if one height dominates among the level surfaces."""
    height = (points - centre) @ up
    level = normals @ up > 0.97  # only the top: the underside has the same area
    if level.sum() < 50:
        return np.zeros(len(points), dtype=bool)
    edges = np.arange(height[level].min(), height[level].max() + 2 * _BOARD_M, _BOARD_M / 2)
    count = np.histogram(height[level], edges)[0]
    fullest = int(np.argmax(count))
    if count[fullest] < 0.1 * level.sum():
        return np.zeros(len(points), dtype=bool)
    middle = 0.5 * (edges[fullest] + edges[fullest + 1])
    return height < middle + _BOARD_M


def _dome(centre: Array, up: Array, distance_m: float) -> list[Array]:
    """Return the eye positions on a dome of directions around the centre."""
    axes = _plane_axes(up)
    eyes: list[Array] = []
    for tilt in np.radians(_DOME_TILTS_DEG):
        count = 1 if tilt == 0 else 12
        for azimuth in np.arange(count) * 2 * np.pi / count:
            sideways = np.cos(azimuth) * axes[0] + np.sin(azimuth) * axes[1]
            eyes.append(centre + distance_m * (np.cos(tilt) * up + np.sin(tilt) * sideways))
    return eyes


def _simplified(surface: Surface) -> tuple[Array, NDArray[np.int64]]:
    """Return the mesh with vertices merged within cells of _CELL_M: fine enough for occlusion, and fast.

    A cell has the place of its vertex that comes first in the faces.
    """
    used = np.zeros(len(surface.vertices_m), dtype=np.bool_)
    used[surface.faces.ravel()] = True
    cells = np.floor(surface.vertices_m[used] / _CELL_M).astype(np.int64)
    cells -= cells.min(axis=0)
    extent = cells.max(axis=0) + 1
    keys, number = np.unique((cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2], return_inverse=True)
    of_vertex = np.zeros(len(used), dtype=np.int64)
    of_vertex[used] = number
    first = np.full(len(keys), -1, dtype=np.int64)
    joined: list[NDArray[np.int64]] = [np.zeros((0, 3), dtype=np.int64)]
    for block in surface.blocks():
        faces = of_vertex[surface.faces[block]]
        met, at = np.unique(faces.ravel(), return_index=True)
        new = first[met] < 0
        first[met[new]] = surface.faces[block].ravel()[at[new]]
        solid = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])
        joined.append(np.unique(faces[solid], axis=0))
    return surface.vertices_m[first], np.unique(np.concatenate(joined), axis=0)
