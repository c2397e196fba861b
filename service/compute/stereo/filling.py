"""Fills a surface where nothing was matched: by a closed guess, as far as the views allow it.

A face of the guess is taken where the surface is neither near nor far, where some view sees it, and where depth maps
do not see through it. What no view can see stays open.

Source of the carving, with depth in place of colour: Kutulakos and Seitz, "A theory of shape by space carving", IJCV
2000.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.ground_truth.distances.neighbours import PointIndex
from service.compute.ground_truth.surface import IntArray, Surface
from service.compute.pixels.ray_mesh import RayMesh
from service.compute.stereo.matching import DepthMap
from service.compute.stereo.pairs import StereoView
from service.core.geometry import Array, Transform, apply, inverse

_THROUGH = 2  # depth maps that contradict a face before it goes

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class FillLimits:
    """When a face of the guess is taken, in metres.

    Attributes:
        near_m: the surface itself counts up to this distance.
        far_m: beyond this distance from the surface, the guess is worth nothing.
        behind_m: a depth map sees through a face if its surface lies farther behind it than this.
    """

    near_m: float
    far_m: float
    behind_m: float


def filled(
    surface: Surface,
    guess: Surface,
    maps: Sequence[DepthMap],
    views: Sequence[StereoView],
    limits: FillLimits,
) -> Surface:
    """The surface with those faces of a closed guess that fill its holes, as parts of their own.

    Args:
        surface: what was matched, in metres.
        guess: a surface without holes near it.
        maps: the depth that was matched.
        views: of the scene.
        limits: when a face is taken.
    """
    away = PointIndex(surface.vertices_m).nearest(guess.vertices_m, limits.far_m)[0]
    lacking: Mask = np.any(away[guess.faces] > limits.near_m, axis=1)
    kept: Mask = np.all(np.isfinite(away)[guess.faces], axis=1)
    kept &= np.linalg.norm(guess.area_vectors_m2, axis=1) > 0  # RayMesh leaves the others out
    centres = guess.vertices_m[guess.faces].mean(axis=1)
    index = np.flatnonzero(kept & lacking)
    through = np.zeros(len(index), dtype=np.int64)
    for one in maps:
        through += _seen_through(one, centres[index], limits.behind_m)
    kept[index[through >= _THROUGH]] = False
    left, filling = guess.faces[kept], np.flatnonzero(lacking[kept])
    if not len(filling):
        return surface
    rays, middles = RayMesh(guess.vertices_m, left), centres[kept][filling]
    seen = np.zeros(len(filling), dtype=np.bool_)
    for view in views:
        seen |= _seen(rays, view, middles, limits.near_m)
    return _joined(surface, guess.vertices_m, left[filling[seen]])


def _joined(one: Surface, vertices_m: Array, faces: IntArray) -> Surface:
    """With more faces (F, 3) of other vertices (V, 3), of which only the used ones are added."""
    used, compact = np.unique(faces, return_inverse=True)
    return Surface(
        np.concatenate([one.vertices_m, vertices_m[used]]),
        np.concatenate([one.faces, compact.reshape(-1, 3).astype(np.int64) + len(one.vertices_m)]),
    )


def _seen_through(one: DepthMap, points_m: Array, behind_m: float) -> Mask:
    """(N,) whether a depth map has its surface behind points (N, 3)."""
    u, v, z = _pixels(one.camera, one.T_world_camera, points_m)
    k = np.flatnonzero(z > 0)
    depth = one.depth_m[np.rint(v[k]).astype(np.int64), np.rint(u[k]).astype(np.int64)]
    out = np.zeros(len(points_m), dtype=np.bool_)
    out[k] = depth > z[k] + behind_m  # false where the depth is not known
    return out


def _seen(rays: RayMesh, view: StereoView, points_m: Array, before_m: float) -> Mask:
    """(N,) whether points (N, 3) are in a view's image, with no face nearer to it by more than `before_m`."""
    inside = np.flatnonzero(_pixels(view.camera, view.T_world_camera, points_m)[2] > 0)
    way = points_m[inside] - view.eye_m
    met = rays.planes_seen(view.T_world_camera)[rays.first_face(view.eye_m, np.ascontiguousarray(way, np.float32))]
    with np.errstate(invalid="ignore", divide="ignore"):
        share = met[:, 3] / np.einsum("ni,ni->n", met[:, :3], way @ view.T_world_camera[:3, :3])
    out = np.zeros(len(points_m), dtype=np.bool_)
    out[inside] = ~((1 - share) * np.linalg.norm(way, axis=1) > before_m)
    return out


def _pixels(camera: CameraModel, T_world_camera: Transform, points_m: Array) -> tuple[Array, Array, Array]:
    """Columns and rows (N,) of points (N, 3) in a pinhole camera's image, and their depth; 0 outside of the image."""
    x, y, z = apply(inverse(T_world_camera), points_m).T
    with np.errstate(invalid="ignore", divide="ignore"):
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside = (z > 0) & (u > -0.5) & (v > -0.5) & (u < camera.width - 0.5) & (v < camera.height - 0.5)
    return u, v, np.where(inside, z, 0.0)
