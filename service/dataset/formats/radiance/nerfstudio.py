"""nerfstudio's transforms.json with depth and masks, in metres."""

from __future__ import annotations

from typing import Any

from service.compute.pixels.views import DEPTH_UNIT_MM, coded_depth
from service.compute.poses.pose_files import OPENGL, transforms_intrinsics
from service.core.units import metres
from service.dataset.formats.colmap.model import write_images
from service.dataset.formats.meshes import mask_png, png
from service.dataset.posed.exporter import Exporter
from service.dataset.posed.folder import ExportFolder, Part
from service.dataset.posed.records import DataSet

PINHOLE_REMEDY = "Choose a format with undistorted images"


def write(dataset: DataSet, folder: ExportFolder) -> None:
    """`transforms.json`, `images/`, `depth/` (16 bit, 0.1 mm, 0 where none is known) and `masks/` (0: leave out).

    Poses are camera to world with OpenGL's axes, in metres and the frame of the mesh. Keep them with
    `nerfstudio-data --orientation-method none --center-method none --auto-scale-poses False
    --depth-unit-scale-factor 1e-4`.

    Raises:
        DataError: a camera has the rational distortion k4, k5, k6.
    """
    frames = [
        {
            "file_path": f"images/{view.file}",
            "depth_file_path": f"depth/{view.name}.png",
            "mask_path": f"masks/{view.name}.png",
            **transforms_intrinsics(view.camera, remedy=PINHOLE_REMEDY),
            "transform_matrix": (view.T_world_camera @ OPENGL).tolist(),
            "covariance": view.covariance.tolist(),
        }
        for view in dataset.views
    ]
    files = {view.name: f"images/{view.file}" for view in dataset.views}
    document: dict[str, Any] = {
        "simulated": dataset.simulated,
        "camera_model": "OPENCV",
        "depth_unit_scale_factor": metres(DEPTH_UNIT_MM),
        "train_filenames": [files[name] for name in dataset.splits.train],
        "val_filenames": [files[name] for name in dataset.splits.test],
        "test_filenames": [files[name] for name in dataset.splits.test],
        "frames": frames,
    }
    folder.json("transforms.json", document)
    write_images(dataset, folder, "images")
    for view in dataset.views:
        folder.file(
            f"depth/{view.name}.png",
            lambda view=view: png(coded_depth(dataset.pixels.depth_m(view)), dataset.mark),
            Part("depth", view.name),
        )
        folder.file(
            f"masks/{view.name}.png",
            lambda view=view: mask_png(dataset.pixels.valid(view) & ~dataset.pixels.markers(view), dataset.mark),
            Part("mask", view.name),
        )


KIND = Exporter("nerfstudio", "nerfstudio's transforms.json, with depth and masks", write)
