"""Plain files: original images, the camera, the poses and the mesh, as orthocapture's own commands read them."""

from __future__ import annotations

from service.compute.poses.pose_files import write_camera_json, write_poses_csv, write_transforms_json
from service.dataset.export_folder import ExportFolder
from service.dataset.exporter import Exporter, ground_truth_ply
from service.dataset.formats.colmap import write_images
from service.dataset.records import DataSet, only_camera


def write(dataset: DataSet, folder: ExportFolder) -> None:
    """`images/`, `camera.json`, `poses.csv`, `transforms.json`, `mesh.ply`, and the scanner's own export in `scan/`.

    An anonymous export has no `scan/`.
    `poses.csv` is T_world_camera in metres, x right, y down, z forward, with the quaternion's scalar last.
    `transforms.json` has the same poses with OpenGL's axes. In `camera.json` the centre of the first pixel is (0, 0),
    in `transforms.json` it is (0.5, 0.5). `mesh.ply` is in metres; if CT and scan were fused, each vertex has its
    `source` (0: CT, 1: scan, 2: blend) and `sigma_m` along its normal. The files in `scan/`, with materials and
    textures, are as the scanner wrote them: in the same frame, in the scanner's unit (mostly millimetres).
    Each further camera of the rig has its own `images/`, `camera.json`, `poses.csv` and `transforms.json` in
    `further/NAME/`; how it was mounted, and its clock's offset, are in `dataset.json`.

    Raises:
        DataError: the first camera's views differ in their intrinsics.
    """
    for device in sorted({view.device for view in dataset.views}):
        one = dataset.keeping(tuple(view.name for view in dataset.views if view.device == device))
        _write_camera(one, folder, f"further/{device}/" if device else "")
    folder.file("mesh.ply", lambda: ground_truth_ply(dataset.mesh, dataset.mark))
    for file in dataset.scan_files:
        folder.file(f"scan/{file.name}", file.path.read_bytes)


def _write_camera(dataset: DataSet, folder: ExportFolder, place: str) -> None:
    """The images of one camera with their poses; `place` is "" or ends with `/`."""
    camera = only_camera(dataset, "a plain data set")
    poses = {view.file: view.T_world_camera for view in dataset.views}
    in_images = {f"images/{name}": T for name, T in poses.items()}
    simulated = dataset.simulated
    folder.written_by(f"{place}camera.json", lambda path: write_camera_json(path, camera, simulated=simulated))
    folder.written_by(f"{place}poses.csv", lambda path: write_poses_csv(path, poses))
    folder.written_by(
        f"{place}transforms.json", lambda path: write_transforms_json(path, camera, in_images, simulated=simulated)
    )
    write_images(dataset, folder, f"{place}images")


KIND = Exporter(
    "plain", "plain files: images, camera.json, poses.csv, transforms.json, mesh.ply, the scanner's files", write
)
