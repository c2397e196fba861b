"""Renders a mesh's depth and normals as a camera sees them, and says which points of a surface views see."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.pixels.rays import PixelRays, RayMesh, pixel_rays
from service.core.geometry import Array, Transform, apply, inverse

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
    """The mesh as the camera at T_world_camera (4, 4) sees it, from the first rows of the image to the last.

    Raises:
        ComputeError: as `pixel_rays`.
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
    """Depth and normal of the rays of some rows on the planes (N, 4) of the faces that they hit."""
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
    """The whole image at once: 16 bytes for each pixel, 1 GB at 60 million.

    Raises:
        ComputeError: as `pixel_rays`.
    """
    depth = np.empty((camera.height, camera.width), dtype=np.float32)
    normal = np.empty((camera.height, camera.width, 3), dtype=np.float32)
    for rows in seen_rows(surface, camera, T_world_camera):
        depth[rows.first : rows.first + len(rows.depth_m)] = rows.depth_m
        normal[rows.first : rows.first + len(rows.depth_m)] = rows.normal
    return SurfaceImage(depth, normal)


def depth_map(surface: RayMesh, camera: CameraModel, T_world_camera: Transform) -> Float32s:
    """(H, W) z-depth in metres alone; 0 where no surface is seen.

    Raises:
        ComputeError: as `pixel_rays`.
    """
    depth = np.empty((camera.height, camera.width), dtype=np.float32)
    for rows in seen_rows(surface, camera, T_world_camera):
        depth[rows.first : rows.first + len(rows.depth_m)] = rows.depth_m
    return depth


_TOLERANCE_M = 1e-3  # a point so far behind the depth of its pixel is still on the surface that is seen


def seen_points(
    points_m: Array, camera: CameraModel, T_world_camera: Transform, depth_m: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Whether (N,) a view sees points (N, 3) of the world: within the picture and not occluded.

    Args:
        points_m: on the surface that the depth is of.
        camera: of the depth.
        T_world_camera: (4, 4) of the view.
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
    """Share of a mesh's area that at least so many views see, for each number in `at_least`.

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
