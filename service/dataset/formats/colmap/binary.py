"""COLMAP model in binary, with the calibrated camera (OPENCV or FULL_OPENCV) and the original images."""

from __future__ import annotations

import numpy as np

from service.dataset.formats.colmap.model import NO_POINTS, README, write_images, write_model_binary
from service.dataset.posed.exporter import Exporter
from service.dataset.posed.folder import ExportFolder
from service.dataset.posed.records import DataSet


def write(dataset: DataSet, folder: ExportFolder) -> None:
    """`sparse/0/*.bin`, `images/`."""
    write_model_binary(dataset, folder, "sparse/0", np.empty((0, 3)))
    folder.text("README.txt", README.format(mark=dataset.mark, points=NO_POINTS))
    write_images(dataset, folder, "images")


KIND = Exporter("colmap-binary", "COLMAP model in binary, with the calibrated camera", write)
