"""The pixels that spheres and their posts cover in an image, from their known positions; occlusion is ignored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import cone_of_sphere
from service.compute.pixels.render import PixelRays, pixel_rays
from service.core.geometry import Array, Transform, apply, inverse

_AROUND = 96  # points of a circle
_BETWEEN = 16  # points that follow the distortion along each edge of an outline
_MARGIN_PX = 4.0  # outlines are cut so far outside the image
_SHIFT = 4  # OpenCV's fixed point: 1/16 px


@dataclass(frozen=True, slots=True)
class WorldSphere:
    """A sphere in the world frame."""

    centre_m: Array  # (3,)
    radius_m: float


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A straight cylinder in the world frame, for example the post under a sphere."""

    top_m: Array  # (3,) on its axis
    foot_m: Array  # (3,)
    radius_m: float


def posts_below(spheres: Sequence[WorldSphere], up: Array, length_m: float, radius_m: float) -> tuple[Cylinder, ...]:
    """Return a post from the centre of each sphere downwards; `up` (3,) is a unit vector in the world frame."""
    return tuple(Cylinder(sphere.centre_m, sphere.centre_m - length_m * up, radius_m) for sphere in spheres)


def marker_mask(
    camera: CameraModel, T_world_camera: Transform, spheres: Sequence[WorldSphere], posts: Sequence[Cylinder] = ()
) -> NDArray[np.bool_]:
    """Compute the (H, W) pixels that a sphere or post covers or touches, also where something else hides it.

    An outline is widened to whole pixels, so the mask never misses a pixel of a marker.

    Raises:
        ComputeError: the distortion folds within the image, so that some pixels have no ray.
    """
    mask = np.zeros((camera.height, camera.width), dtype=np.uint8)
    T_camera_world = inverse(T_world_camera)
    frustum = _frustum(pixel_rays(camera), camera)
    for sphere in spheres:
        centre = apply(T_camera_world, sphere.centre_m)
        if centre[2] > sphere.radius_m:
            _fill(mask, camera, frustum, _sphere_outline(centre, sphere.radius_m))
    for post in posts:
        ends = apply(T_camera_world, np.stack([post.top_m, post.foot_m]))
        _fill(mask, camera, frustum, _post_outline(ends, post.radius_m))
    return mask.astype(np.bool_)


def hull_mask(camera: CameraModel, T_world_camera: Transform, points_m: Array) -> NDArray[np.bool_]:
    """Compute the (H, W) pixels within the outline of points (N, 3) of the world, such as a specimen's spheres.

    Points behind the camera do not count.

    Raises:
        ComputeError: the distortion folds within the image, so that some pixels have no ray.
    """
    mask = np.zeros((camera.height, camera.width), dtype=np.uint8)
    points = apply(inverse(T_world_camera), points_m)
    _fill(mask, camera, _frustum(pixel_rays(camera), camera), _hull(points[points[:, 2] > 0]))
    return mask.astype(np.bool_)


def _hull(points: Array) -> Array:
    """Return the rays (K, 3) of the outline of points (N, 3) before the camera."""
    flat = (points[:, :2] / points[:, 2:]).astype(np.float32)
    if len(flat) < 3:
        return np.empty((0, 3))
    hull = np.asarray(cv2.convexHull(flat), dtype=np.float64).reshape(-1, 2)
    return np.concatenate([hull, np.ones((len(hull), 1))], axis=1)


def _sphere_outline(centre: Array, radius_m: float) -> Array:
    cone = cone_of_sphere(centre, radius_m)
    azimuth = np.linspace(0.0, 2 * np.pi, _AROUND, endpoint=False)
    # The polygon is drawn around the circle, not within it.
    return cone.rays(azimuth, np.arctan(np.tan(np.full(_AROUND, cone.half_angle_rad)) / np.cos(np.pi / _AROUND)))


def _post_outline(ends: Array, radius_m: float) -> Array:
    """Return the rays (N, 3) of the outline: the convex hull of the images of both ends."""
    near = 2 * radius_m
    low, high = ends[np.argsort(ends[:, 2])]
    if high[2] <= near:
        return np.empty((0, 3))
    if low[2] < near:  # only what lies before the camera
        low = low + (high - low) * (near - low[2]) / (high[2] - low[2])
    axis = (high - low) / max(float(np.linalg.norm(high - low)), 1e-12)
    side = np.linalg.svd(axis[None])[2][1:]
    angle = np.linspace(0.0, 2 * np.pi, _AROUND, endpoint=False)[:, None]
    circle = radius_m / np.cos(np.pi / _AROUND) * (np.cos(angle) * side[0] + np.sin(angle) * side[1])
    return _hull(np.concatenate([low + circle, high + circle]))


def _frustum(rays: PixelRays, camera: CameraModel) -> Array:
    """Return (5, 3) planes with n · ray >= 0 for all rays of the image and a margin around it."""
    edge = np.concatenate([rays.xy(0, 1)[0], rays.xy(camera.height - 1, camera.height)[0]])
    sides = np.einsum("vk,kuc->vuc", rays.rows, rays.columns[:, [0, -1]]).reshape(-1, 2)
    margin = _MARGIN_PX / np.array([camera.fx, camera.fy])
    low = np.minimum(edge.min(axis=0), sides.min(axis=0)) - margin
    high = np.maximum(edge.max(axis=0), sides.max(axis=0)) + margin
    return np.array([[1, 0, -low[0]], [-1, 0, high[0]], [0, 1, -low[1]], [0, -1, high[1]], [0, 0, 1.0]])


def _fill(mask: NDArray[np.uint8], camera: CameraModel, frustum: Array, outline: Array) -> None:
    """Draw a convex outline of rays (N, 3), cut to the frustum."""
    for plane in frustum:
        outline = _clip(outline, plane)
        if len(outline) < 3:
            return
    outline = outline / outline[:, 2:]
    share = np.linspace(0.0, 1.0, _BETWEEN, endpoint=False)[None, :, None]
    following = np.roll(outline, -1, axis=0)
    dense = (outline[:, None] * (1 - share) + following[:, None] * share).reshape(-1, 3)
    pixels = np.rint(camera.project(dense) * (1 << _SHIFT)).astype(np.int32)
    cv2.fillPoly(mask, [pixels], 1, shift=_SHIFT)


def _clip(polygon: Array, plane: Array) -> Array:
    """Return the part of a convex polygon of rays (N, 3) with plane · ray >= 0 (Sutherland and Hodgman, 1974)."""
    kept: list[Array] = []
    height = polygon @ plane
    for i in range(len(polygon)):
        j = (i + 1) % len(polygon)
        if height[i] >= 0:
            kept.append(polygon[i])
        if (height[i] >= 0) != (height[j] >= 0):
            kept.append((polygon[i] * height[j] - polygon[j] * height[i]) / (height[j] - height[i]))
    return np.array(kept).reshape(-1, 3)
