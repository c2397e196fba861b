"""Renders a mesh as a camera sees it: rays of pixels, depth, normals and what is seen; masks of spheres and posts."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.markers.cones import cone_of_sphere
from service.core.errors import ComputeError, ConfigurationError, DataError
from service.core.geometry import Array, Transform, apply, inverse

_DEGREES = (8, 16, 32, 64)
_LARGEST_ERROR_PX = 1e-4
_CHECKED = 41  # places across the image, and down it, where the polynomials are compared with the camera


@dataclass(frozen=True, slots=True)
class PixelRays:
    """Normalised coordinates x/z, y/z of every pixel centre: rows[v] @ columns, both as polynomials.

    Attributes:
        width, height: size of the image in pixels.
        rows: (height, K) basis of the row.
        columns: (K, width, 2) basis of the column, for x and y.
    """

    width: int
    height: int
    rows: Array
    columns: Array

    def xy(self, begin: int, end: int) -> Array:
        """Return (end - begin, width, 2) undistorted x/z, y/z of the pixel centres of rows [begin, end)."""
        flat = self.columns.reshape(len(self.columns), -1)
        return (self.rows[begin:end] @ flat).reshape(end - begin, self.width, 2)

    def turned(self, rotation: Array) -> NDArray[np.float32]:
        """Return (K, width, 3) columns of directions rotation (3, 3) @ (x, y, 1): multiply by `rows` as float32."""
        turned = self.columns @ rotation[:, :2].T
        turned[0] += rotation[:, 2]  # the first basis function of the rows is 1
        return turned.astype(np.float32)


def pixel_rays(camera: CameraModel) -> PixelRays:
    """Return the rays of a camera, distorted or not; pixel centres lie at integer coordinates.

    The inverse of the distortion has no closed form. It is interpolated at Chebyshev nodes of the whole image, which
    converges geometrically for a smooth function (Trefethen, "Approximation Theory and Approximation Practice",
    2013, chapter 8), and projected again to check it: the largest error is 1e-4 px.

    Raises:
        ComputeError: the distortion folds within the image, so that some pixels have no ray.
    """
    if not camera.distortion.any():
        return _pinhole(camera)
    for degree in _DEGREES:
        rays = _interpolated(camera, degree)
        if _error_px(rays, camera) <= _LARGEST_ERROR_PX:
            return rays
    raise ComputeError(
        "the camera's distortion cannot be inverted for every pixel of its image",
        where=f"k1 {camera.k1:.4g}, k2 {camera.k2:.4g}, k3 {camera.k3:.4g}",
        remedy="Calibrate with board corners in all corners of the image, or with fewer distortion terms",
    )


def _pinhole(camera: CameraModel) -> PixelRays:
    rows = np.ones((camera.height, 2))
    rows[:, 1] = (np.arange(camera.height) - camera.cy) / camera.fy
    columns = np.zeros((2, camera.width, 2))
    columns[0, :, 0] = (np.arange(camera.width) - camera.cx) / camera.fx
    columns[1, :, 1] = 1.0
    return PixelRays(camera.width, camera.height, rows, columns)


def _interpolated(camera: CameraModel, degree: int) -> PixelRays:
    nodes = np.asarray(chebyshev.chebpts1(degree + 1), dtype=np.float64)
    u, v = (0.5 * (nodes + 1) * (size - 1) for size in (camera.width, camera.height))
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    values = camera.normalise(grid).reshape(degree + 1, degree + 1, 2)
    # Values at the nodes to coefficients: the discrete orthogonality of the Chebyshev polynomials.
    to_coefficients = np.asarray(chebyshev.chebvander(nodes, degree), dtype=np.float64).T * (2.0 / (degree + 1))
    to_coefficients[0] /= 2.0
    coefficients = np.einsum("iv,jw,vwc->ijc", to_coefficients, to_coefficients, values)
    columns = np.einsum("uj,ijc->iuc", _basis(camera.width, degree), coefficients)
    return PixelRays(camera.width, camera.height, _basis(camera.height, degree), np.ascontiguousarray(columns))


def _basis(size: int, degree: int) -> Array:
    """Return (size, degree + 1) Chebyshev polynomials at the pixel centres."""
    return np.asarray(chebyshev.chebvander(np.linspace(-1.0, 1.0, size), degree), dtype=np.float64)


def _error_px(rays: PixelRays, camera: CameraModel) -> float:
    """Return the largest distance between a pixel and its ray's projection, over a grid up to the image's edges."""
    u, v = (np.unique(np.linspace(0, size - 1, _CHECKED).astype(int)) for size in (rays.width, rays.height))
    xy = np.einsum("vk,kuc->vuc", rays.rows[v], rays.columns[:, u])
    points = np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=2).reshape(-1, 3)
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    return float(np.abs(camera.project(points) - pixels).max())


_CHUNK = 500_000  # faces whose corners are in memory at a time


class RayMesh:
    """A triangle mesh in the world frame, with a tree for rays that is built once, at the first ray of all images."""

    def __init__(self, vertices_m: Array, faces: NDArray[np.integer]) -> None:
        """Take vertices (V, 3) in metres and faces (F, 3); faces without area are left out.

        Raises:
            DataError: no face has an area, or a vertex is not finite.
        """
        if not np.isfinite(vertices_m).all():
            raise DataError("the mesh has vertices that are not finite", remedy="Export the mesh again")
        self._centre_m = 0.5 * (vertices_m.min(axis=0) + vertices_m.max(axis=0)) if len(vertices_m) else np.zeros(3)
        normal, offset = _planes(vertices_m, faces)
        kept = np.isfinite(normal[:, 0])
        if not kept.any():
            raise DataError("the mesh has no face with an area", remedy="Use a mesh, not a point cloud")
        self._normal, self._offset_m = normal[kept], offset[kept]
        # Single precision is enough near the mesh's centre, wherever the world's origin lies.
        self._near = np.ascontiguousarray(vertices_m - self._centre_m, dtype=np.float32)
        self._faces = np.ascontiguousarray(faces[kept], dtype=np.int32)

    def __getstate__(self) -> dict[str, object]:
        """Return what travels to another process: not the tree, which that builds again."""
        return {name: value for name, value in self.__dict__.items() if name != "_scene"}

    @cached_property
    def _scene(self) -> Any:
        """The tree; many exports need none. Raises ConfigurationError without embreex."""
        return _tree(self._near, self._faces)

    def first_face(self, eye_m: Array, directions: NDArray[np.float32]) -> NDArray[np.int32]:
        """Return the index (N,) of the first face that each ray from the eye (3,) along (N, 3) hits; -1 for none.

        Raises:
            ConfigurationError: embreex, which casts the rays, is not installed.
        """
        origin = (eye_m - self._centre_m).astype(np.float32)
        return np.asarray(self._scene.run(np.broadcast_to(origin, directions.shape), directions), dtype=np.int32)

    def depths(self, T_world_camera: Transform, rays: Array) -> Array:
        """Return depths (N,) along z at which rays (N, 3) of a camera, z = 1, meet the surface; NaN if they do not.

        Raises:
            ConfigurationError: embreex, which casts the rays, is not installed.
        """
        eye, directions = T_world_camera[:3, 3], rays @ T_world_camera[:3, :3].T
        face = self.first_face(eye, np.ascontiguousarray(directions, dtype=np.float32))
        normal = self._normal[face]
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (self._offset_m[face] - normal @ eye) / np.einsum("ij,ij->i", normal, directions)
        return np.where((face >= 0) & np.isfinite(depth) & (depth > 0), depth, np.nan)

    def planes_seen(self, T_world_camera: Transform) -> Array:
        """Return (F + 1, 4) faces' unit normals towards the camera, in its frame, and n · p (≤ 0) for their points p.

        The last row, which the index -1 names, is zero.
        """
        R, eye = T_world_camera[:3, :3], T_world_camera[:3, 3]
        planes = np.zeros((len(self._normal) + 1, 4))
        np.matmul(self._normal, R, out=planes[:-1, :3])
        np.subtract(self._offset_m, self._normal @ eye, out=planes[:-1, 3])
        planes[planes[:, 3] > 0] *= -1
        return planes


def _planes(vertices_m: Array, faces: NDArray[np.integer]) -> tuple[Array, Array]:
    """Return the unit normals (F, 3) and offsets n · p (F,); NaN for faces without area."""
    normal, offset = np.empty((len(faces), 3)), np.empty(len(faces))
    for begin in range(0, len(faces), _CHUNK):
        chosen = slice(begin, begin + _CHUNK)
        a, b, c = (vertices_m[faces[chosen, k]] for k in range(3))
        cross = np.cross(b - a, c - a)
        with np.errstate(invalid="ignore", divide="ignore"):
            normal[chosen] = cross / np.linalg.norm(cross, axis=1, keepdims=True)
        offset[chosen] = np.sum(normal[chosen] * a, axis=1)
    return normal, offset


def _tree(vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> Any:
    try:
        rtcore, meshes = (
            importlib.import_module(f"embreex.{name}") for name in ("rtcore_scene", "mesh_construction")
        )
    except ImportError as error:
        raise ConfigurationError(
            "embreex, which casts rays at a mesh, is not installed",
            remedy="Compute depth on a machine with an x86-64 processor",
        ) from error
    scene = rtcore.EmbreeScene()
    meshes.TriangleMesh(scene, vertices, faces)
    scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))  # the first ray builds the tree
    return scene


Float32s = NDArray[np.float32]

_RAYS = 80_000  # in one tile: its arrays stay in the processor's cache
_GRAZING = -1e-4  # cosine of the steepest ray: beyond, a plane's depth is not determined


@dataclass(frozen=True, slots=True)
class SurfaceRows:
    """Some rows of an image.

    Attributes:
        first: row of the image at which they begin.
        depth_m: (n, W) z in the camera frame, not the length of the ray; 0 where no surface is seen.
        normal: (n, W, 3) unit normals of the faces, in the camera frame, towards the camera; 0 where depth is 0.
    """

    first: int
    depth_m: Float32s
    normal: Float32s


@dataclass(frozen=True, slots=True)
class SurfaceImage:
    """A whole image: `depth_m` (H, W) and `normal` (H, W, 3) as in SurfaceRows."""

    depth_m: Float32s
    normal: Float32s

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(H, W) where a surface is seen."""
        return self.depth_m > 0


def seen_rows(surface: RayMesh, camera: CameraModel, T_world_camera: Transform) -> Iterator[SurfaceRows]:
    """Yield the mesh as the camera at T_world_camera (4, 4) sees it, from the first rows of the image to the last.

    Raises:
        ComputeError: the distortion folds within the image, so that some pixels have no ray.
    """
    rays = pixel_rays(camera)
    planes = surface.planes_seen(T_world_camera)
    turned = rays.turned(T_world_camera[:3, :3]).reshape(rays.columns.shape[0], -1)
    rows = rays.rows.astype(np.float32)
    step = max(1, _RAYS // camera.width)
    for begin in range(0, camera.height, step):
        end = min(begin + step, camera.height)
        directions = (rows[begin:end] @ turned).reshape(-1, 3)
        face = surface.first_face(T_world_camera[:3, 3], directions)
        yield _on_planes(planes.take(face, axis=0, mode="wrap"), rays, begin, end)


def _on_planes(planes: NDArray[np.float64], rays: PixelRays, begin: int, end: int) -> SurfaceRows:
    """Return the depth and normal of the rays of some rows on the planes (N, 4) of the faces that they hit."""
    plane = planes.reshape(end - begin, rays.width, 4)
    xy = rays.xy(begin, end)
    slope = plane[..., 0] * xy[..., 0]
    slope += plane[..., 1] * xy[..., 1]
    slope += plane[..., 2]
    hidden = slope > _GRAZING
    slope[hidden] = -np.inf
    depth = np.empty(slope.shape, dtype=np.float32)
    np.divide(plane[..., 3], slope, out=depth, casting="same_kind")
    normal = plane[..., :3].astype(np.float32)
    if np.count_nonzero(hidden & (plane[..., 3] < 0)):
        normal[hidden] = 0.0
    return SurfaceRows(begin, depth, normal)


def seen(surface: RayMesh, camera: CameraModel, T_world_camera: Transform) -> SurfaceImage:
    """Render the whole image at once: 16 bytes for each pixel, 1 GB at 60 million.

    Raises:
        ComputeError: the distortion folds within the image, so that some pixels have no ray.
    """
    depth = np.empty((camera.height, camera.width), dtype=np.float32)
    normal = np.empty((camera.height, camera.width, 3), dtype=np.float32)
    for rows in seen_rows(surface, camera, T_world_camera):
        depth[rows.first : rows.first + len(rows.depth_m)] = rows.depth_m
        normal[rows.first : rows.first + len(rows.depth_m)] = rows.normal
    return SurfaceImage(depth, normal)


def depth_map(surface: RayMesh, camera: CameraModel, T_world_camera: Transform) -> Float32s:
    """Render (H, W) z-depth in metres alone; 0 where no surface is seen.

    Raises:
        ComputeError: the distortion folds within the image, so that some pixels have no ray.
    """
    depth = np.empty((camera.height, camera.width), dtype=np.float32)
    for rows in seen_rows(surface, camera, T_world_camera):
        depth[rows.first : rows.first + len(rows.depth_m)] = rows.depth_m
    return depth


_TOLERANCE_M = 1e-3  # a point so far behind the depth of its pixel is still on the surface that is seen


def seen_points(
    points_m: Array, camera: CameraModel, T_world_camera: Transform, depth_m: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Return whether (N,) a view sees points (N, 3) of the world: within the picture and not occluded.

    Args:
        points_m: (N, 3) points on the surface whose depth `depth_m` is.
        camera: the camera of the depth.
        T_world_camera: (4, 4) pose of the view.
        depth_m: (H, W) z of the surface; 0 where none is seen.
    """
    before = apply(inverse(T_world_camera), points_m)
    with np.errstate(all="ignore"):
        pixels = camera.project(before)
    inside = (before[:, 2] > 0) & np.isfinite(pixels).all(axis=1)
    inside &= ((pixels > -0.5) & (pixels < np.array([camera.width, camera.height]) - 0.5)).all(axis=1)
    # On a steep surface the depth of the pixel's centre differs from that of the point: the deepest neighbour counts.
    deepest = cv2.dilate(depth_m, np.ones((3, 3), np.uint8))
    column, row = np.rint(pixels[inside]).astype(np.int64).T
    seen = np.zeros(len(points_m), dtype=np.bool_)
    seen[inside] = before[inside, 2] <= deepest[row, column] + _TOLERANCE_M
    return seen


def covered_shares(
    counts: NDArray[np.int64], points_m: Array, triangles: NDArray[np.int64], at_least: Sequence[int]
) -> tuple[float, ...]:
    """Return the share of a mesh's area that at least so many views see, for each number in `at_least`.

    Args:
        counts: (V,) views that see each vertex.
        points_m: (V, 3) vertices.
        triangles: (F, 3); a third of each belongs to each of its corners.
        at_least: numbers of views.
    """
    a, b, c = (points_m[triangles[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    weight = np.zeros(len(points_m))
    np.add.at(weight, triangles.ravel(), np.repeat(area / 6, 3))
    whole = max(float(weight.sum()), 1e-300)
    return tuple(float(weight[counts >= least].sum()) / whole for least in at_least)


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
