"""Formats that are COLMAP models: as text, in binary, undistorted, and the layouts of ETH3D and SuGaR."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from service.compute.camera_model import CameraModel
from service.compute.poses.pose_files import HALF_PIXEL
from service.core.errors import DataError
from service.core.geometry import Array, Transform, inverse
from service.dataset.export_folder import ExportFolder, Part
from service.dataset.exporter import Exporter, ply
from service.dataset.records import DataSet, Mesh, PosedView

_MODEL_IDS = {"PINHOLE": 1, "OPENCV": 4, "FULL_OPENCV": 6}
README = """COLMAP model. {mark}
Frame: world (the frame of the scan), metres. Poses are world to camera, cameras as COLMAP defines them: the centre of
the first pixel is (0.5, 0.5). {points}
"""
NO_POINTS = "There are no points: the model holds nothing of the ground truth."


def write_images(dataset: DataSet, folder: ExportFolder, place: str) -> None:
    """The picture files of all views."""
    for view in dataset.views:
        folder.file(f"{place}/{view.file}", lambda view=view: dataset.pixels.picture(view), Part("image", view.name))


def write_model_text(dataset: DataSet, folder: ExportFolder, place: str, *, images: str = "") -> None:
    """cameras.txt, images.txt and an empty points3D.txt, as COLMAP's documentation describes them.

    `images` stands before the names of pictures: "" or a folder below COLMAP's image_path, ending with `/`.

    Raises:
        DataError: the name of a picture has white space, which ends a name in this format.
    """
    spaced = [view.file for view in dataset.views if view.file.split() != [view.file]]
    if spaced:
        raise DataError(
            "COLMAP's text format cannot hold image names with spaces",
            where=spaced[0],
            remedy="Choose the format colmap-binary",
        )
    head = f"# {dataset.mark}\n" * dataset.simulated
    cameras = camera_ids(dataset.views)
    rows = [
        f"{number} {model} {camera.width} {camera.height} {' '.join(map(repr, parameters))}"
        for camera, number in cameras.items()
        for model, parameters in [model_of(camera)]
    ]
    folder.text(f"{place}/cameras.txt", head + "".join(f"{row}\n" for row in rows))
    lines: list[str] = []
    for number, view in enumerate(dataset.views, start=1):
        q, t = world_to_camera(view.T_world_camera)
        numbers = " ".join(repr(float(x)) for x in (*q, *t))
        lines.append(
            f"{number} {numbers} {cameras[view.camera]} {images}{view.file}\n\n"
        )  # an empty line: no 2D points
    folder.text(f"{place}/images.txt", head + "".join(lines))
    folder.text(f"{place}/points3D.txt", head)


def write_model_binary(dataset: DataSet, folder: ExportFolder, place: str, points_m: Array) -> None:
    """cameras.bin, images.bin and points3D.bin with grey points (N, 3) without tracks; little endian."""
    cameras = camera_ids(dataset.views)
    blob = struct.pack("<Q", len(cameras))
    for camera, number in cameras.items():
        model, parameters = model_of(camera)
        blob += struct.pack("<iiQQ", number, _MODEL_IDS[model], camera.width, camera.height)
        blob += struct.pack(f"<{len(parameters)}d", *parameters)
    folder.file(f"{place}/cameras.bin", lambda: blob)
    images = struct.pack("<Q", len(dataset.views))
    for number, view in enumerate(dataset.views, start=1):
        q, t = world_to_camera(view.T_world_camera)
        images += struct.pack("<I7dI", number, *q, *t, cameras[view.camera])
        images += view.file.encode() + b"\0" + struct.pack("<Q", 0)
    folder.file(f"{place}/images.bin", lambda: images)
    folder.file(f"{place}/points3D.bin", lambda: _points(points_m))


def _points(points_m: Array) -> bytes:
    rows = (struct.pack("<Q3d3BdQ", k, *point, 128, 128, 128, 0.0, 0) for k, point in enumerate(points_m, start=1))
    return struct.pack("<Q", len(points_m)) + b"".join(rows)


def camera_ids(views: Sequence[PosedView]) -> dict[CameraModel, int]:
    """Return a number from 1 for each different camera."""
    return {camera: k for k, camera in enumerate(dict.fromkeys(view.camera for view in views), start=1)}


def model_of(camera: CameraModel) -> tuple[str, list[float]]:
    """Return COLMAP's name of the camera's model, and its parameters."""
    pinhole = [camera.fx, camera.fy, camera.cx + HALF_PIXEL, camera.cy + HALF_PIXEL]
    if not camera.distortion.any():
        return "PINHOLE", pinhole
    four = [*pinhole, camera.k1, camera.k2, camera.p1, camera.p2]
    more = [camera.k3, camera.k4, camera.k5, camera.k6]
    return ("FULL_OPENCV", four + more) if any(more) else ("OPENCV", four)


def world_to_camera(T_world_camera: Transform) -> tuple[Array, Array]:
    """Return the quaternion (4,) with the scalar first, and translation (3,)."""
    T = inverse(T_world_camera)
    return Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True), T[:3, 3]


def write_text(dataset: DataSet, folder: ExportFolder) -> None:
    """`sparse/0/*.txt`, `images/`."""
    write_model_text(dataset, folder, "sparse/0")
    folder.text("README.txt", README.format(mark=dataset.mark, points=NO_POINTS))
    write_images(dataset, folder, "images")


def write_binary(dataset: DataSet, folder: ExportFolder) -> None:
    """`sparse/0/*.bin`, `images/`."""
    write_model_binary(dataset, folder, "sparse/0", np.empty((0, 3)))
    folder.text("README.txt", README.format(mark=dataset.mark, points=NO_POINTS))
    write_images(dataset, folder, "images")


_IMAGES = "dslr_images_undistorted"
_README = """The layout of ETH3D's multi-view sets. {mark}
Metres; the scan and the poses share one frame. images.txt names the images below images/, which is COLMAP's
image_path. ground_truth_depth has one file for each image: float32, little
endian, row by row, z in metres, inf where the scan is not seen.
"""


def write_eth3d(dataset: DataSet, folder: ExportFolder) -> None:
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


_POINTS = 100_000  # as 3D Gaussian splatting begins with where there are none
_RANDOM = "The points are random within the box of the scene: they hold nothing of the ground truth but its extent."


def write_sugar(dataset: DataSet, folder: ExportFolder) -> None:
    """`images/`, `sparse/0` in binary, and the same cameras and images as text in `sparse/text`.

    Train with `--eval False`: SuGaR's default keeps every eighth image for itself.
    """
    write_model_binary(dataset, folder, "sparse/0", first_points(dataset.mesh))
    write_model_text(dataset, folder, "sparse/text")
    folder.text("README.txt", README.format(mark=dataset.mark, points=_RANDOM))
    write_images(dataset, folder, "images")


def first_points(mesh: Mesh) -> Array:
    """Return (N, 3) random points in the box of the mesh, always the same ones."""
    low, high = mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)
    return np.random.default_rng(0).uniform(low, high, (_POINTS, 3))


KINDS = (
    Exporter("colmap", "COLMAP model as text, with the calibrated camera", write_text),
    Exporter("colmap-binary", "COLMAP model in binary, with the calibrated camera", write_binary),
    Exporter("colmap-pinhole", "COLMAP model as text, with undistorted images", write_text, pinhole=True),
    Exporter("eth3d", "the layout of ETH3D's multi-view sets", write_eth3d, pinhole=True),
    Exporter(
        "sugar", "SuGaR and 3D Gaussian splatting: undistorted images and a COLMAP model", write_sugar, pinhole=True
    ),
)
