"""Which points of a surface a view sees, from the view's depth, and how much of the surface several views see."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.core.geometry import Array, Transform, apply, inverse

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
