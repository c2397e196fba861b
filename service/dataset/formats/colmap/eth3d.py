"""The layout of ETH3D's high-resolution multi-view sets: undistorted images, COLMAP text, scan, and its depth."""

from __future__ import annotations

import numpy as np

from service.dataset.formats.colmap.model import write_images, write_model_text
from service.dataset.formats.meshes import ply
from service.dataset.posed.exporter import Exporter
from service.dataset.posed.folder import ExportFolder, Part
from service.dataset.posed.records import DataSet, PosedView

_IMAGES = "dslr_images_undistorted"
_README = """The layout of ETH3D's multi-view sets. {mark}
Metres; the scan and the poses share one frame. images.txt names the images below images/, which is COLMAP's
image_path. ground_truth_depth has one file for each image: float32, little
endian, row by row, z in metres, inf where the scan is not seen.
"""


def write(dataset: DataSet, folder: ExportFolder) -> None:
    """`images/`, `dslr_calibration_undistorted/`, `dslr_scan_eval/scan1.ply` and `ground_truth_depth/`.

    As in ETH3D's own sets, `images.txt` names the images by their path below `images/`, which is COLMAP's image_path.
    """
    write_model_text(dataset, folder, "dslr_calibration_undistorted", images=f"{_IMAGES}/")
    folder.text("README.txt", _README.format(mark=dataset.mark))
    folder.file("dslr_scan_eval/scan1.ply", lambda: ply(dataset.mesh.vertices_m, dataset.mesh.faces, dataset.mark))
    write_images(dataset, folder, f"images/{_IMAGES}")
    for view in dataset.views:
        folder.file(
            f"ground_truth_depth/{_IMAGES}/{view.file}",
            lambda view=view: _depth(dataset, view),
            Part("depth", view.name),
        )


def _depth(dataset: DataSet, view: PosedView) -> bytes:
    depth = dataset.pixels.depth_m(view)
    return np.where(depth > 0, depth, np.inf).astype("<f4").tobytes()


KIND = Exporter("eth3d", "the layout of ETH3D's multi-view sets", write, pinhole=True)
