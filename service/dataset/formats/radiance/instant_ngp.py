"""Instant-NGP's transforms.json: the scene in the unit box, poses centred, so that its meshes come back exactly."""

from __future__ import annotations

from service.compute.poses.pose_files import OPENGL, transforms_intrinsics
from service.core.errors import DataError
from service.dataset.formats.colmap.model import write_images
from service.dataset.formats.radiance.nerfstudio import PINHOLE_REMEDY
from service.dataset.formats.radiance.unit_box import unit_box
from service.dataset.posed.exporter import Exporter
from service.dataset.posed.folder import ExportFolder
from service.dataset.posed.records import DataSet, only_camera


def write(dataset: DataSet, folder: ExportFolder) -> None:
    """`transforms.json`, `images/` and `unit_box.json`, which says how a mesh comes back.

    The centring is in the poses and the three offsets are equal: Instant-NGP adds them before it cycles the axes.

    Raises:
        DataError: the views have several cameras, or one with k3 … k6.
    """
    camera = only_camera(dataset, "Instant-NGP")
    if camera.k3 or camera.k4 or camera.k5 or camera.k6:
        raise DataError("Instant-NGP knows only k1, k2, p1, p2", remedy="Export undistorted images")
    box = unit_box(dataset.mesh)
    folder.json(
        "transforms.json",
        {
            "simulated": dataset.simulated,
            **transforms_intrinsics(camera, remedy=PINHOLE_REMEDY),
            "aabb_scale": 1,
            "scale": box.scale,
            "offset": [0.5, 0.5, 0.5],
            "frames": [
                {
                    "file_path": f"images/{view.file}",
                    "transform_matrix": (box.pose(view.T_world_camera) @ OPENGL).tolist(),
                }
                for view in dataset.views
            ],
        },
    )
    # It cycles axes: (x, y, z) of its mesh is (Y, Z, X) of the poses that it was given (`nerf_matrix_to_ngp` in its
    # include/neural-graphics-primitives/nerf_loader.h).
    folder.json("unit_box.json", box.record(dataset, mesh_axes=(2, 0, 1)))
    write_images(dataset, folder, "images")


KIND = Exporter("instant-ngp", "Instant-NGP's transforms.json, the scene in the unit box", write, one_camera=True)
