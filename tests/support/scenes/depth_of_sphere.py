"""Exact depth maps of a sphere at the origin."""

from __future__ import annotations

import numpy as np

from service.compute.camera_model import CameraModel
from service.compute.stereo.matching import DepthMap
from service.core.geometry import Transform, inverse

CAMERA = CameraModel(200, 200, 300.0, 310.0, 99.5, 98.0)


def depth_of_sphere(T_world_camera: Transform, radius_m: float) -> DepthMap:
    """What a pinhole camera at this pose would measure; NaN beside the sphere."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
    centre = inverse(T_world_camera)[:3, 3]
    a, b = np.sum(rays**2, axis=-1), rays @ centre
    root = b**2 - a * (centre @ centre - radius_m**2)
    depth = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, np.nan)
    return DepthMap(depth.astype(np.float32), CAMERA, T_world_camera, 1.0)
