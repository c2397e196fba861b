"""SuGaR's and 3D Gaussian splatting's folder: a COLMAP model with undistorted images and points to begin with."""

from __future__ import annotations

import numpy as np

from service.core.geometry import Array
from service.dataset.formats.colmap.model import README, write_images, write_model_binary, write_model_text
from service.dataset.posed.exporter import Exporter
from service.dataset.posed.folder import ExportFolder
from service.dataset.posed.records import DataSet, Mesh

_POINTS = 100_000  # as 3D Gaussian splatting begins with where there are none
_RANDOM = "The points are random within the box of the scene: they hold nothing of the ground truth but its extent."


def write(dataset: DataSet, folder: ExportFolder) -> None:
    """`images/`, `sparse/0` in binary, and the same cameras and images as text in `sparse/text`.

    Train with `--eval False`: SuGaR's default keeps every eighth image for itself.
    """
    write_model_binary(dataset, folder, "sparse/0", first_points(dataset.mesh))
    write_model_text(dataset, folder, "sparse/text")
    folder.text("README.txt", README.format(mark=dataset.mark, points=_RANDOM))
    write_images(dataset, folder, "images")


def first_points(mesh: Mesh) -> Array:
    """(N, 3) random points in the box of the mesh, always the same ones."""
    low, high = mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)
    return np.random.default_rng(0).uniform(low, high, (_POINTS, 3))


KIND = Exporter(
    "sugar", "SuGaR and 3D Gaussian splatting: undistorted images and a COLMAP model", write, pinhole=True
)
