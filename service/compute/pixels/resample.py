"""Resamples photographs with the matching camera: undistorted, or to another resolution and aspect ratio."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.pixels.render import pixel_rays
from service.core.errors import ConfigurationError
from service.core.geometry import Array

_RAYS = 500_000  # pixels whose places in the photograph are in memory at a time


@dataclass(frozen=True, slots=True)
class Undistorted:
    """A resampled photograph.

    Attributes:
        camera: its intrinsics, without distortion.
        image: (H, W, 3) BGR or (H, W) grey; black where the photograph has no pixel.
        valid: (H, W) where the photograph has a pixel.
    """

    camera: CameraModel
    image: NDArray[np.uint8]
    valid: NDArray[np.bool_]


def pinhole_of(camera: CameraModel) -> CameraModel:
    """Return the camera without its distortion: same size, focal lengths and principal point."""
    return dataclasses.replace(camera, k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0, k4=0.0, k5=0.0, k6=0.0)


def undistorted(image: NDArray[np.uint8], camera: CameraModel) -> Undistorted:
    """Return the photograph (H, W) or (H, W, 3) as the pinhole camera `pinhole_of(camera)` would have taken it.

    Cubic interpolation at places rounded to 1/32 px, in tiles of rows.
    """
    pinhole = pinhole_of(camera)
    out = np.empty_like(image)
    valid = np.empty(image.shape[:2], dtype=np.bool_)
    for begin, end, at in _places(pinhole, camera):
        valid[begin:end] = _within(at, camera)
        places = at.astype(np.float32)
        part = cv2.remap(image, places[..., 0], places[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        part[~valid[begin:end]] = 0
        out[begin:end] = part
    return Undistorted(pinhole, out, valid)


def valid_pixels(camera: CameraModel) -> NDArray[np.bool_]:
    """Return (H, W) pixels of the undistorted image for which the photograph has one."""
    valid = np.empty((camera.height, camera.width), dtype=np.bool_)
    for begin, end, at in _places(pinhole_of(camera), camera):
        valid[begin:end] = _within(at, camera)
    return valid


def _places(pinhole: CameraModel, camera: CameraModel) -> Iterator[tuple[int, int, Array]]:
    """Yield tiles of rows [begin, end) of the undistorted image, and (end - begin, W, 2) places in the photograph."""
    rays = pixel_rays(pinhole)
    step = max(1, _RAYS // camera.width)
    for begin in range(0, camera.height, step):
        end = min(begin + step, camera.height)
        xy = rays.xy(begin, end)
        at = camera.project(np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=2).reshape(-1, 3))
        yield begin, end, at.reshape(end - begin, camera.width, 2)


def _within(at: Array, camera: CameraModel) -> NDArray[np.bool_]:
    inside = (at >= -0.5) & (at <= np.array([camera.width, camera.height]) - 0.5)
    return inside[..., 0] & inside[..., 1]


def camera_at(camera: CameraModel, width: int, height: int) -> CameraModel:
    """Return the camera of the image that `resample` returns.

    Raises:
        ConfigurationError: the size is larger than the photograph.
    """
    whole = _whole(camera, width, height)
    x, y = (whole.width - width) // 2, (whole.height - height) // 2
    return dataclasses.replace(whole, width=width, height=height, cx=whole.cx - x, cy=whole.cy - y)


def resample(image: NDArray[np.uint8], camera: CameraModel, width: int, height: int) -> NDArray[np.uint8]:
    """Resize a photograph (H, W, 3) to (height, width, 3): reduce by area averaging, then crop evenly.

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
