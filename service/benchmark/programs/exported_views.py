"""The images of an exported COLMAP model with pinhole cameras, as our own programs of reconstruction read them."""

from __future__ import annotations

from pathlib import Path

import pycolmap

from service.compute.camera_model import CameraModel
from service.compute.images.files import read_grey
from service.compute.poses.files.pose_files import HALF_PIXEL
from service.compute.stereo.pairs import StereoView
from service.core.errors import DataError
from service.core.geometry import transform


def views_of(data: Path) -> tuple[StereoView, ...]:
    """The images of an export in the format `colmap-pinhole`.

    Raises:
        DataError: a camera is not a pinhole, or an image cannot be read.
    """
    model = pycolmap.Reconstruction(str(data / "sparse" / "0"))
    views: list[StereoView] = []
    for image in sorted(model.images.values(), key=lambda image: image.name):
        camera = model.cameras[image.camera_id]
        if camera.model.name != "PINHOLE":
            raise DataError("a camera has distortion", where=image.name, remedy="Export as colmap-pinhole")
        fx, fy, cx, cy = (float(x) for x in camera.params)
        pinhole = CameraModel(camera.width, camera.height, fx, fy, cx - HALF_PIXEL, cy - HALF_PIXEL)
        pose = image.cam_from_world().inverse().matrix()
        views.append(StereoView(read_grey(data / "images" / image.name), pinhole, transform(pose[:, :3], pose[:, 3])))
    return tuple(views)
