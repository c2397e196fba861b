"""A small posed data set of textured slabs: its images have features, and its surface is known."""

from __future__ import annotations

import functools
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.images.render import RayMesh
from service.compute.images.views import splits
from service.dataset.pixels import Photographs
from service.dataset.records import DataSet, Mesh, PosedView
from tests.support.scenes.textured_scene import Slab, camera_of_width, render, ring_of_poses, slabs


@functools.cache
def slab_scene() -> tuple[Slab, ...]:
    """The slabs that the data set shows."""
    return tuple(slabs(3))


def slab_mesh() -> Mesh:
    """The upper faces of the slabs, as far as the images show the table."""
    corners: list[tuple[float, float, float]] = []
    for slab in slab_scene():
        (x0, y0), (x1, y1) = np.clip(slab.low, -0.2, 0.2), np.clip(slab.high, -0.2, 0.2)
        corners += [(x, y, slab.z) for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
    first = 4 * np.arange(len(slab_scene()), dtype=np.int64)[:, None]
    return Mesh(np.array(corners), np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])]))


def slab_data_set(folder: Path) -> DataSet:
    """Write distorted photographs of the slabs, twelve around them, into a folder, and give the data set of them."""
    camera, mesh = camera_of_width(320), slab_mesh()
    poses = {f"view_{k:02d}": T for k, T in enumerate(ring_of_poses(12))}
    views = tuple(PosedView(name, ".png", camera, T, np.zeros((6, 6))) for name, T in poses.items())
    for k, view in enumerate(views):
        assert cv2.imwrite(str(folder / view.file), render(slab_scene(), camera, view.T_world_camera, k))
    files = {view.name: folder / view.file for view in views}
    sees: dict[str, NDArray[np.bool_]] = {view.name: np.ones(5, dtype=np.bool_) for view in views}
    pixels = Photographs(files, RayMesh(mesh.vertices_m, mesh.faces), ())
    return DataSet("slabs", True, {}, views, pixels, mesh, splits(sees))
