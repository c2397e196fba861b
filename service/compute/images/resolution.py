"""Resamples a photograph to another resolution and aspect ratio, with the matching camera."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.core.errors import ConfigurationError


def camera_at(camera: CameraModel, width: int, height: int) -> CameraModel:
    """The camera of the image that `resample` returns.

    Raises:
        ConfigurationError: the size is larger than the photograph.
    """
    whole = _whole(camera, width, height)
    x, y = (whole.width - width) // 2, (whole.height - height) // 2
    return dataclasses.replace(whole, width=width, height=height, cx=whole.cx - x, cy=whole.cy - y)


def resample(image: NDArray[np.uint8], camera: CameraModel, width: int, height: int) -> NDArray[np.uint8]:
    """The photograph (H, W, 3) as (height, width, 3): reduced by area averaging, then cropped evenly on both sides.

    An aspect ratio other than the camera's (1920 × 1080 from a 3:2 sensor, as in the paper) crops two sides; pixels
    stay square.

    Raises:
        ConfigurationError: the size is larger than the photograph.
    """
    whole = _whole(camera, width, height)
    reduced = cv2.resize(image, (whole.width, whole.height), interpolation=cv2.INTER_AREA)
    x, y = (whole.width - width) // 2, (whole.height - height) // 2
    return np.ascontiguousarray(reduced[y : y + height, x : x + width], dtype=np.uint8)


def _whole(camera: CameraModel, width: int, height: int) -> CameraModel:
    scale = max(width / camera.width, height / camera.height)
    if scale > 1 or width < 1 or height < 1:
        raise ConfigurationError(
            f"{width} × {height} is not a reduction of {camera.width} × {camera.height}",
            remedy="Name resolutions that are smaller than the photographs, or none",
        )
    return camera.scaled(max(width, round(camera.width * scale)), max(height, round(camera.height * scale)))
