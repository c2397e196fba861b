"""NeuS2's data: RGBA images with the specimen's mask, OpenCV poses (`from_na`), the scene in the unit box."""

from __future__ import annotations

import numpy as np

from service.compute.poses.pose_files import HALF_PIXEL
from service.dataset.formats.meshes import png
from service.dataset.formats.radiance.unit_box import unit_box
from service.dataset.posed.exporter import Exporter
from service.dataset.posed.folder import ExportFolder, Part
from service.dataset.posed.records import DataSet, PosedView, only_camera


def write(dataset: DataSet, folder: ExportFolder) -> None:
    """`transform.json`, `images/*.png` with alpha 0 where no surface or a marker is seen, and `unit_box.json`,
    which says how a mesh comes back.

    NeuS2 only tests whether `from_na` is there; camera to world, x right, y down, z forward.

    Raises:
        DataError: the views have several cameras.
    """
    camera = only_camera(dataset, "NeuS2")
    box = unit_box(dataset.mesh)
    K = np.eye(4)
    K[:3, :3] = camera.matrix
    K[:2, 2] += HALF_PIXEL
    folder.json(
        "transform.json",
        {
            "simulated": dataset.simulated,
            "from_na": True,
            "w": camera.width,
            "h": camera.height,
            "aabb_scale": 1.0,
            "scale": box.scale,
            "offset": [0.5, 0.5, 0.5],
            "frames": [
                {
                    "file_path": f"images/{view.name}.png",
                    "transform_matrix": box.pose(view.T_world_camera).tolist(),
                    "intrinsic_matrix": K.tolist(),
                }
                for view in dataset.views
            ],
        },
    )
    # With `from_na` it cycles no axes.
    folder.json("unit_box.json", box.record(dataset, mesh_axes=(0, 1, 2)))
    for view in dataset.views:
        folder.file(f"images/{view.name}.png", lambda view=view: _with_alpha(dataset, view), Part("image", view.name))


def _with_alpha(dataset: DataSet, view: PosedView) -> bytes:
    pixels = dataset.pixels
    shown = (pixels.depth_m(view) > 0) & pixels.valid(view) & ~pixels.markers(view)
    return png(np.dstack([pixels.colours(view), np.where(shown, np.uint8(255), np.uint8(0))]), dataset.mark)


KIND = Exporter(
    "neus2", "NeuS2: RGBA images with masks, the scene in the unit box", write, pinhole=True, one_camera=True
)
