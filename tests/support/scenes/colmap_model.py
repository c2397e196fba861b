"""Writes poses as a COLMAP text model, with COLMAP's own library."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pycolmap

from service.compute.camera_model import CameraModel
from service.compute.sfm.colmap import to_colmap_camera, to_colmap_pose
from service.core.geometry import Transform


def write_colmap_text(folder: Path, camera: CameraModel, T_world_camera: Mapping[str, Transform]) -> None:
    """A model without points, in a folder that is made if need be."""
    folder.mkdir(parents=True, exist_ok=True)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(to_colmap_camera(camera))
    for image_id, (name, T) in enumerate(T_world_camera.items(), start=1):
        image = pycolmap.Image(name=name, camera_id=1, image_id=image_id)
        model.add_image_with_trivial_frame(image, to_colmap_pose(T))
    model.write_text(str(folder))
