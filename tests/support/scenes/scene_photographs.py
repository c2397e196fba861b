"""Photographs of the simulated scene from given poses, as files of a folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from service.core.geometry import Transform, look_at
from simulators.rendering.render import REFERENCE, Renderer
from simulators.scene.world import NOMINAL_LUX, SCENE_CENTRE_M, Scene

_DISTANCE_M = 0.62


def pose_above(azimuth_rad: float, tilt_rad: float) -> Transform:
    """T_world_camera of a camera that looks at the scene's centre, tilted from the vertical."""
    horizontal = np.array([np.cos(azimuth_rad), np.sin(azimuth_rad), 0.0])
    out: NDArray[np.float64] = np.sin(tilt_rad) * horizontal + np.array([0.0, 0.0, np.cos(tilt_rad)])
    up = np.array([0.1, 1.0 if out[1] < 0 else -1.0, 0.0])
    return look_at(SCENE_CENTRE_M + _DISTANCE_M * out, SCENE_CENTRE_M, up)


def photograph(scene: Scene, poses: Mapping[str, Transform], width_px: int, folder: Path) -> None:
    """Write one JPEG for each name in `poses` (T_world_camera), with the control spheres, before the spray."""
    renderer = Renderer(width_px)
    intrinsics = scene.camera_intrinsics(width_px).to_json()
    folder.mkdir()
    for number, (name, T_world_camera) in enumerate(poses.items()):
        view = {
            "T_world_camera": T_world_camera.tolist(),
            "intrinsics": intrinsics,
            "scene": {"seed": scene.seed, "spray": False, "control_spheres": True, "board": None},
            "light_lux": NOMINAL_LUX,
        }
        picture = renderer.render(view, REFERENCE, number)
        assert cv2.imwrite(str(folder / name), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
