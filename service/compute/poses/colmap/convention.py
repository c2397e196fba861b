"""The only conversion between our conventions and COLMAP's: half a pixel, and the direction of poses."""

from __future__ import annotations

import numpy as np
import pycolmap

from service.compute.camera_model import CameraModel
from service.core.errors import DataError
from service.core.geometry import Array, Transform, inverse, transform

HALF_PIXEL = 0.5  # COLMAP's first pixel spans 0..1 with its centre at 0.5; ours is centred at 0


def to_colmap_camera(camera: CameraModel) -> pycolmap.Camera:
    """COLMAP's camera for our calibrated one: OPENCV, or FULL_OPENCV if it has more than k1, k2, p1, p2."""
    more = [camera.k3, camera.k4, camera.k5, camera.k6]
    return pycolmap.Camera(
        camera_id=1,
        model="FULL_OPENCV" if any(more) else "OPENCV",
        width=camera.width,
        height=camera.height,
        params=[
            camera.fx,
            camera.fy,
            camera.cx + HALF_PIXEL,
            camera.cy + HALF_PIXEL,
            camera.k1,
            camera.k2,
            camera.p1,
            camera.p2,
            *(more if any(more) else []),
        ],
    )


def from_colmap_camera(camera: pycolmap.Camera) -> CameraModel:
    """Our camera from a COLMAP camera.

    Raises:
        DataError: its model has distortion terms that ours lacks.
    """
    p = [float(v) for v in camera.params]
    size = (int(camera.width), int(camera.height))
    name = camera.model_name
    more: list[float] = []
    if name in {"OPENCV", "FULL_OPENCV"}:
        fx, fy, cx, cy, k1, k2, p1, p2, *more = p
    elif name == "PINHOLE":
        (fx, fy, cx, cy), (k1, k2, p1, p2) = p, (0.0,) * 4
    elif name in {"SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"}:
        f, cx, cy, *radial = p
        fx = fy = f
        k1, k2, p1, p2 = (*radial, 0.0, 0.0, 0.0, 0.0)[:4]
    else:
        raise DataError(
            f"camera model {name} is not supported",
            where=f"camera {camera.camera_id}",
            remedy="Export the model with an OPENCV, FULL_OPENCV, RADIAL, SIMPLE_RADIAL or PINHOLE camera",
        )
    return CameraModel(*size, fx, fy, cx - HALF_PIXEL, cy - HALF_PIXEL, k1, k2, p1, p2, *more)


def to_colmap_pose(T_world_camera: Transform) -> pycolmap.Rigid3d:
    """COLMAP's cam_from_world for our T_world_camera (4, 4)."""
    T_camera_world = inverse(T_world_camera)
    return pycolmap.Rigid3d(pycolmap.Rotation3d(T_camera_world[:3, :3]), T_camera_world[:3, 3])


def from_colmap_pose(cam_from_world: pycolmap.Rigid3d) -> Transform:
    """T_world_camera (4, 4) from COLMAP's cam_from_world."""
    rotation = np.asarray(cam_from_world.rotation.matrix(), dtype=np.float64)
    return inverse(transform(rotation, np.asarray(cam_from_world.translation, dtype=np.float64)))


def from_colmap_pixels(points: Array) -> Array:
    """Our pixels (N, 2) from COLMAP's image coordinates (N, 2)."""
    return points - HALF_PIXEL


def to_colmap_pixels(pixels: Array) -> Array:
    """COLMAP's image coordinates (N, 2) from our pixels (N, 2)."""
    return pixels + HALF_PIXEL
