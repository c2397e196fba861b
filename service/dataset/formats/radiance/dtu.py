"""The layout of DTU as IDR, NeuS and their successors read it: cameras.npz, images and masks."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray

from service.core.geometry import Array, inverse
from service.dataset.formats.meshes import mask_png, png
from service.dataset.formats.radiance.unit_box import unit_box
from service.dataset.posed.exporter import Exporter
from service.dataset.posed.folder import ExportFolder, Part
from service.dataset.posed.records import DataSet, PosedView


def write(dataset: DataSet, folder: ExportFolder) -> None:
    """`cameras.npz`, `image/000000.png` and `mask/000000.png` (255: the mesh, and no marker), in order of the views.

    `world_mat_i` (4, 4) maps world points in metres to pixels, whose centres lie at integers, as these readers sample
    them. `scale_mat_i` maps the unit sphere to the world. `names` has the views' names.
    """
    folder.file("cameras.npz", lambda: _cameras(dataset))
    for k, view in enumerate(dataset.views):
        folder.file(
            f"image/{k:06d}.png",
            lambda view=view: png(dataset.pixels.colours(view), dataset.mark),
            Part("image", view.name),
        )
        folder.file(
            f"mask/{k:06d}.png",
            lambda view=view: mask_png(_shown(dataset, view), dataset.mark),
            Part("mask", view.name),
        )


def _shown(dataset: DataSet, view: PosedView) -> NDArray[np.bool_]:
    return (dataset.pixels.depth_m(view) > 0) & dataset.pixels.valid(view) & ~dataset.pixels.markers(view)


def _cameras(dataset: DataSet) -> bytes:
    box = unit_box(dataset.mesh)
    half_diagonal = float(np.linalg.norm(np.ptp(dataset.mesh.vertices_m, axis=0))) / 2
    scale = np.diag([half_diagonal, half_diagonal, half_diagonal, 1.0])
    scale[:3, 3] = box.centre_m
    arrays: dict[str, Array] = {}
    for k, view in enumerate(dataset.views):
        projection = np.eye(4)
        projection[:3] = view.camera.matrix @ inverse(view.T_world_camera)[:3]
        arrays[f"world_mat_{k}"], arrays[f"scale_mat_{k}"] = projection, scale
    buffer = io.BytesIO()
    names = np.array([view.name for view in dataset.views])
    np.savez(buffer, allow_pickle=False, simulated=np.array(dataset.simulated), names=names, **arrays)
    return buffer.getvalue()


KIND = Exporter("dtu", "DTU as IDR and NeuS read it: cameras.npz, images and masks", write, pinhole=True)
