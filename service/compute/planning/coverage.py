"""What images see of the specimen, and which to take next: coverage of its surface, predicted target errors.

Coverage is relative to the surface visible from a dome of directions above: surfaces inside, underneath or in folds
that no camera reaches do not count as missing.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, cast

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from trimesh.ray.ray_pyembree import RayMeshIntersector

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import Cone, ObservedCones, cone_of_sphere
from service.compute.markers.records import SphereOutline
from service.compute.scene import ScanSpheres
from service.compute.surfaces.chamfer import random_places
from service.compute.surfaces.surface import IntArray, Surface
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, apply, inverse, place_jacobian, skew

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


_PRIOR_VIEWS = 2.0  # weight of the arm's nominal scatter, in views
_OUTLIER = 25.0  # squared Mahalanobis distance of an outline from the solution, including the arm's scatter


@dataclass(frozen=True, slots=True)
class ViewInformation:
    """One view: information (6, 6) of its outlines, and the scan's offset (6,), as (d, w), from them alone."""

    information: Array = field(repr=False)
    offset: Array
    spheres: int


def view_information(
    T_base_camera: Transform,
    T_base_scan: Transform,
    outlines: Sequence[SphereOutline],
    markers: Mapping[int, int],
    spheres: ScanSpheres,
    centre_m: Array,
    pose_sigma_m: float,
) -> ViewInformation:
    """Compute the information of one image's assigned outlines about T_base_scan, linearised there.

    Args:
        T_base_camera: pose of the camera.
        T_base_scan: the pose at which it is linearised.
        outlines: the image's outlines.
        markers: outline → sphere.
        spheres: the spheres in the scan frame.
        centre_m: (3,) centre of the scene, base frame.
        pose_sigma_m: the arm's nominal scatter; outlines that contradict the solution by much more are excluded.
    """
    base = apply(T_base_scan, spheres.centres_m)
    normal, b, used = np.zeros((6, 6)), np.zeros(6), 0
    for o, m in markers.items():
        outline = outlines[o]
        residual, J = cone_rows(T_base_camera, base[m], centre_m, spheres.radius_m, outline.cone)
        slack = pose_sigma_m**2 * (J[:, :3] @ J[:, :3].T)
        if residual @ np.linalg.solve(outline.cone_covariance + slack, residual) > _OUTLIER:
            continue
        weight = np.linalg.inv(outline.cone_covariance)
        normal += J.T @ weight @ J
        b -= J.T @ weight @ residual
        used += 1
    offset = np.linalg.lstsq(normal, b, rcond=1e-12)[0] if used >= 3 else np.full(6, np.nan)
    return ViewInformation(normal, np.asarray(offset, dtype=np.float64), used)


def predicted_information(
    T_base_camera: Transform, spheres_base_m: Array, radius_m: float, centre_m: Array, cone_covariance: Array
) -> Array:
    """Predict the information (6, 6) of a view of spheres (K, 3) with outlines of this covariance (3, 3)."""
    normal = np.zeros((6, 6))
    weight = np.linalg.inv(cone_covariance)
    for sphere in spheres_base_m:
        seen = cone_of_sphere(apply(inverse(T_base_camera), sphere), radius_m)
        _, J = cone_rows(T_base_camera, sphere, centre_m, radius_m, seen)
        normal += J.T @ weight @ J
    return normal


def cone_rows(
    T_base_camera: Transform, sphere_base_m: Array, centre_m: Array, radius_m: float, seen: Cone
) -> tuple[Array, Array]:
    """Return the residual (3,) in radians of a sphere's cone as seen, and its derivative (3, 6) by (d, w)."""
    c = apply(inverse(T_base_camera), sphere_base_m)
    residual, by_centre = ObservedCones.of([seen]).residuals(c[None], radius_m)
    move = T_base_camera[:3, :3].T @ np.hstack([np.eye(3), -skew(sphere_base_m - centre_m)])  # (3, 6) of c
    return residual[0], by_centre[0] @ move


def pose_scatter(views: Sequence[ViewInformation], sigma_m: float, sigma_rad: float) -> Array:
    """Return the covariance P (6, 6) of a station's camera poses, from the views' scatter and the nominal scatter.

    Args:
        views: their offsets scatter by the arm's error and the noise of their outlines.
        sigma_m, sigma_rad: nominal scatter in 3D, with the weight of two views.
    """
    nominal = np.diag([sigma_m**2 / 3] * 3 + [sigma_rad**2 / 3] * 3)
    offsets = np.array([v.offset for v in views if v.spheres >= 4]).reshape(-1, 6)
    if len(offsets) < 2:
        return nominal
    deviations = offsets - offsets.mean(axis=0)
    scatter = deviations.T @ deviations
    return (_PRIOR_VIEWS * nominal + scatter) / (_PRIOR_VIEWS + len(offsets) - 1)


def pose_covariance(informations: Iterable[Array], P: Array) -> Array:
    """Return the covariance (6, 6) of the scan's pose from views with these informations and pose errors P each.

    Raises:
        ComputeError: the views together do not determine the pose.
    """
    normal, middle = np.zeros((6, 6)), np.zeros((6, 6))
    for information in informations:
        normal += information
        middle += information + information @ P @ information
    d = np.sqrt(np.diag(normal))
    if not np.all(d > 0) or np.linalg.cond(normal / np.outer(d, d)) > 1e12:
        raise ComputeError(
            "the views do not determine the pose of the scan", remedy="Take images that show more spheres"
        )
    inverse_normal = np.linalg.inv(normal / np.outer(d, d)) / np.outer(d, d)
    return inverse_normal @ middle @ inverse_normal


def mounting_covariance(
    views: Iterable[tuple[Array, Transform]], T_flange_camera: Transform, covariance: Array, centre_m: Array
) -> Array:
    """Return the covariance (6, 6) of the scan's pose due to the uncertain camera mount, which all views share.

    Args:
        views: information (6, 6) and T_base_camera of each; together they must determine the pose.
        covariance: (6, 6) covariance of T_flange_camera, as (d, w) in flange axes with R → exp(w) R, t → t + d.
        centre_m: (3,) base frame.
    """
    normal, moved = np.zeros((6, 6)), np.zeros((6, 6))
    for information, T_base_camera in views:
        R = T_base_camera[:3, :3] @ T_flange_camera[:3, :3].T
        lever = skew(centre_m - T_base_camera[:3, 3])
        normal += information
        moved += information @ np.block([[R, -lever @ R], [np.zeros((3, 3)), R]])
    d = np.sqrt(np.diag(normal))
    M = np.linalg.solve(normal / np.outer(d, d), moved / d[:, None]) / d[:, None]
    return M @ covariance @ M.T


def lens_covariance_of_pose(
    views: Iterable[tuple[Array, Transform]], camera: CameraModel, covariance: Array, centre_m: Array
) -> Array:
    """Return the covariance (6, 6) of the scan's pose due to the uncertain calibration, which all views share.

    A focal length too long by a share puts the scan nearer by this share of its distance, and a principal point that
    is off puts it aside.

    Args:
        views: information (6, 6) and T_base_camera of each; together they must determine the pose.
        camera: intrinsics.
        covariance: (4, 4) covariance of fx, fy, cx, cy or (8, 8) with the distortion, which counts for nothing at the
            centre.
        centre_m: (3,) base frame.
    """
    normal, moved = np.zeros((6, 6)), np.zeros((6, 4))
    for information, T_base_camera in views:
        c = apply(inverse(T_base_camera), centre_m)
        aside = np.zeros((3, 4))
        aside[2, :2] = -c[2] / (2 * np.array([camera.fx, camera.fy]))
        aside[:2, 2:] = -c[2] * np.diag([1 / camera.fx, 1 / camera.fy])
        normal += information
        moved += information[:, :3] @ T_base_camera[:3, :3] @ aside
    d = np.sqrt(np.diag(normal))
    M = np.linalg.solve(normal / np.outer(d, d), moved / d[:, None]) / d[:, None]
    return M @ covariance[:4, :4] @ M.T


def point_sigmas_m(covariance: Array, points_m: Array) -> Array:
    """Return 3D sigmas (N,), metres, at points (N, 3) from the centre, for a covariance (6, 6) of (d, w)."""
    J = place_jacobian(points_m)
    return np.sqrt(np.einsum("nij,jk,nik->n", J, covariance, J))


_AS_GOOD = 1.01  # errors within 1 % count as equal; coverage and travel then decide


@dataclass(frozen=True, slots=True)
class ViewGain:
    """A possible viewpoint and its predicted gain."""

    name: str
    information: Array = field(repr=False)  # (6, 6), see planning.information
    seen: NDArray[np.bool_] = field(repr=False)  # (N,) points of the coverage surface that it sees
    travel_s: float = 0.0


@dataclass(frozen=True, slots=True)
class CurrentInformation:
    """The information from the station's images so far."""

    informations: tuple[Array, ...] = field(repr=False)
    pose_covariance: Array = field(repr=False)  # P (6, 6), the arm's scatter
    targets_m: Array = field(repr=False)  # (T, 3) target points relative to the scene's centre, base axes
    seen_count: NDArray[np.int64] = field(repr=False)  # (N,) views of each surface point from all stations
    min_views: int = 2
    shared: Array | None = field(default=None, repr=False)  # (6, 6) covariance that further views do not reduce

    def error_m(self, *more: Array) -> float:
        """Predict the worst target's error, m, with this further information added; infinite if undetermined."""
        try:
            covariance = pose_covariance([*self.informations, *more], self.pose_covariance)
        except ComputeError:
            return float("inf")
        if self.shared is not None:
            covariance = covariance + self.shared
        return float(point_sigmas_m(covariance, self.targets_m).max())


@dataclass(frozen=True, slots=True)
class Suggestion:
    """A suggested viewpoint, and the predicted results once it and those before it are taken."""

    name: str
    predicted_error_m: float
    coverage: float


def next_best_views(
    present: CurrentInformation,
    candidates: Sequence[ViewGain],
    *,
    limit_m: float,
    min_coverage: float,
    at_most: int = 6,
) -> tuple[Suggestion, ...]:
    """Choose a short list of viewpoints greedily that brings error and coverage within limits, or `at_most` of them.

    While the error exceeds its limit, each choice minimises it; among equals, the one with the largest coverage, then
    the nearest wins. After that, each choice maximises coverage.
    """
    chosen: list[Suggestion] = []
    informations: list[Array] = []
    count = present.seen_count.copy()
    error = present.error_m()
    left = list(candidates)
    while left and len(chosen) < at_most:
        coverage = _covered(count, present.min_views)
        if error <= limit_m and coverage >= min_coverage:
            break
        errors = np.array([present.error_m(*informations, c.information) for c in left])
        gains = np.array([_gain(count, c.seen, present.min_views) for c in left])
        if error > limit_m and np.isfinite(errors.min()):
            equal = [i for i in range(len(left)) if errors[i] <= _AS_GOOD * errors.min()]
        else:
            equal = list(range(len(left)))
        best = min(equal, key=lambda i: (-round(float(gains[i]), 3), left[i].travel_s, left[i].name))
        pick = left.pop(best)
        informations.append(pick.information)
        count = count + pick.seen
        error = float(errors[best])
        chosen.append(Suggestion(pick.name, error, _covered(count, present.min_views)))
    return tuple(chosen)


def _covered(count: NDArray[np.int64], min_views: int) -> float:
    return float(np.mean(count >= min_views)) if len(count) else 0.0


def _gain(count: NDArray[np.int64], seen: NDArray[np.bool_], min_views: int) -> float:
    """Return the progress of all points towards `min_views`, so that a first view of a point counts too."""
    if not len(count):
        return 0.0
    return float(np.mean(np.minimum(count + seen, min_views) - np.minimum(count, min_views))) / min_views
