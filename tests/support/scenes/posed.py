"""A small posed data set with exact geometry: photographs that are painted from the rays of a known scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.images.render import RayMesh, WorldSphere, pixel_rays, posts_below
from service.compute.images.views import splits
from service.core.geometry import Array, Transform, apply, inverse, look_at
from service.dataset.pixels import Photographs
from service.dataset.records import DataSet, Mesh, PosedView

CAMERA = CameraModel(160, 120, 190.0, 191.0, 78.0, 61.5, -0.12, 0.04, 8e-4, -5e-4)
BOXES_M = np.array([[[-0.08, -0.03, 0.0], [0.08, 0.03, 0.03]], [[0.04, 0.03, 0.0], [0.08, 0.09, 0.05]]])
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class Scene:
    """An L-shaped solid, so that no turn and no mirror maps it to itself, among four spheres."""

    mesh: trimesh.Trimesh
    spheres: tuple[WorldSphere, ...]

    def tone(self, world: Array) -> Array:
        """Brightness of surface points (..., 3): it names the place."""
        return 128 + 60 * np.sin(40 * world[..., 0]) + 55 * np.cos(37 * world[..., 1] + 30 * world[..., 2])

    def distance_m(self, points: Array) -> Array:
        """Distances (N,) of points (N, 3) from the surface of the nearer box."""
        found: list[Array] = []
        for low, high in BOXES_M:
            out = np.abs(points - (low + high) / 2) - (high - low) / 2
            outside = np.linalg.norm(np.maximum(out, 0.0), axis=1)
            found.append(np.abs(outside + np.minimum(out.max(axis=1), 0.0)))
        return np.min(found, axis=0)


def scene() -> Scene:
    """The scene, in metres."""
    first, second = (trimesh.creation.box(bounds=box) for box in BOXES_M)
    vertices = np.concatenate([first.vertices, second.vertices])
    faces = np.concatenate([first.faces, second.faces + len(first.vertices)])
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    at = [(-0.15, -0.1, 0.03), (0.15, -0.11, 0.04), (0.14, 0.15, 0.03), (-0.13, 0.12, 0.05)]
    return Scene(mesh, tuple(WorldSphere(np.array(centre), 0.012) for centre in at))


def reach(eye: Array, directions: Array) -> Array:
    """(N,) how many times the directions (N, 3) from the eye (3,) the nearer box is away; inf: none is hit."""
    found = np.full(len(directions), np.inf)
    for low, high in BOXES_M:
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (low - eye) / directions, (high - eye) / directions
        near, far = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
        found = np.minimum(found, np.where((near <= far) & (near > 0), near, np.inf))
    return found


def poses(count: int) -> dict[str, Transform]:
    """T_world_camera by name, around the scene."""
    angles = np.linspace(0.2, 2 * np.pi, count, endpoint=False)
    eyes = [np.array([0.25 * np.cos(a), 0.25 * np.sin(a), 0.4 + 0.02 * k]) for k, a in enumerate(angles)]
    return {f"v1_{k:03d}": look_at(eye, np.array([0.01, 0.02, 0.02]), UP) for k, eye in enumerate(eyes)}


def posed_data_set(
    folder: Path,
    count: int = 4,
    *,
    camera: CameraModel = CAMERA,
    simulated: bool = True,
    tone: Callable[[Array], Array] | None = None,
    more_spheres: tuple[WorldSphere, ...] = (),
) -> DataSet:
    """Paint the photographs into a folder, and give the data set of them; `tone` replaces that of the scene.

    The scene's own spheres hide nothing of the solid; `more_spheres` may.
    """
    shown = scene()
    shown = replace(shown, spheres=shown.spheres + more_spheres)
    painted = shown.tone if tone is None else tone
    vertices, faces = np.asarray(shown.mesh.vertices), np.asarray(shown.mesh.faces, dtype=np.int64)
    surface = RayMesh(vertices, faces)
    covariance = np.diag([1e-10, 1e-10, 2e-10, 1e-9, 1e-9, 3e-9])
    views = tuple(PosedView(name, ".png", camera, T, covariance) for name, T in poses(count).items())
    files = {view.name: folder / view.file for view in views}
    blank = Photographs(files, surface, shown.spheres)
    for view in views:
        depth = blank.depth_m(view).astype(np.float64)[..., None]
        xy = pixel_rays(camera).xy(0, camera.height)
        world = apply(view.T_world_camera, np.concatenate([xy * depth, depth], axis=2))
        grey = np.where(depth[..., 0] > 0, painted(world), 20.0).astype(np.uint8)
        cv2.imwrite(str(files[view.name]), np.dstack([grey, grey // 2, grey // 3]))
    points = trimesh.sample.sample_surface(shown.mesh, 300, seed=1)[0]
    sees: dict[str, NDArray[np.bool_]] = {}
    for view in views:
        pixels_px = camera.project(apply(inverse(view.T_world_camera), points))
        sees[view.name] = np.asarray((pixels_px > 0).all(axis=1), dtype=np.bool_)
    mark = "simulated" if simulated else ""
    pixels = Photographs(files, surface, shown.spheres, posts_below(shown.spheres, UP, 0.05, 0.004), mark=mark)
    return DataSet(f"run-1 {count}", simulated, {"run": "run-1"}, views, pixels, Mesh(vertices, faces), splits(sees))
