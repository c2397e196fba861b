"""Reads photographs from files: only complete ones, with the pixels as stored."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.images.decode import REDUCED, decode
from service.core.errors import DataError
from service.core.picture_files import (
    JPEG_BEGINS,
    another_kind,
    check_jpeg,
    check_picture,
    kind_of,
    picture_size,
)

# Kinds of pictures that nothing here decodes, and files that are no pictures.
_UNREAD = frozenset({
    "HEIC", "JPEG XL", "Photoshop", "raw file", "PDF", "ZIP", "video", "text", "Git LFS pointer"
})  # fmt: skip
_REMEDY = "Copy the file from the camera again, and use JPEG or PNG images"


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image as stored, after checking that it is complete; a JPEG is not decoded.

    Raises:
        DataError: as `read_image`.
    """
    data = _checked(path)
    if data.startswith(JPEG_BEGINS):
        return picture_size(data, str(path))
    height, width = _decoded(data, path, cv2.IMREAD_GRAYSCALE).shape
    return width, height


def _checked(path: Path) -> bytes:
    """The content of an image file, which decides its kind, not its name."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise _unreadable(path, error) from error
    kind = kind_of(data)
    if kind in _UNREAD:
        raise another_kind(kind, "JPEG or PNG", str(path))
    if not kind and path.suffix.lower() in {".jpg", ".jpeg"}:
        check_jpeg(data, str(path))  # OpenCV would read some formats without a mark of their own
    check_picture(data, str(path))
    return data


def _unreadable(path: Path, error: OSError) -> DataError:
    return DataError(
        f"the image cannot be read: {error.strerror}",
        where=str(path),
        remedy="Check the path and its permissions",
    )


def read_image(path: Path) -> NDArray[np.uint8]:
    """(H, W, 3) BGR as stored: the orientation tag is ignored, to match the camera model.

    Raises:
        DataError: the file is missing, truncated or not a decodable image.
    """
    return _decode(path, cv2.IMREAD_COLOR)


def read_grey(path: Path) -> NDArray[np.uint8]:
    """(H, W) brightness as stored (a JPEG's luma, at full resolution), in a third of the memory of `read_image`.

    Raises:
        DataError: as `read_image`.
    """
    return _decode(path, cv2.IMREAD_GRAYSCALE)


def _decode(path: Path, how: int) -> NDArray[np.uint8]:
    return _decoded(_checked(path), path, how)


def _decoded(data: bytes, path: Path, how: int) -> NDArray[np.uint8]:
    return decode(data, how | cv2.IMREAD_IGNORE_ORIENTATION, name=str(path), remedy=_REMEDY)


def read_image_of(path: Path, camera: CameraModel) -> NDArray[np.uint8]:
    """`read_image` for an image of the camera's size.

    Raises:
        DataError: as `read_image`, or the image has another size.
    """
    image = read_image(path)
    if image.shape[:2] != (camera.height, camera.width):
        raise DataError(
            f"the image has {image.shape[1]}×{image.shape[0]} pixels, "
            f"the camera model is for {camera.width}×{camera.height}",
            where=str(path),
            remedy="Use the calibration made at this image size, and images that no program has rotated or resized",
        )
    return image


def read_reduced(path: Path, camera: CameraModel, least_width: int) -> tuple[NDArray[np.uint8], CameraModel]:
    """The image reduced to a half, a quarter or an eighth, at least `least_width` wide, and its camera.

    A JPEG is decoded at that size, which takes a third of the time and at an eighth 1/64 of the memory.

    Raises:
        DataError: as `read_image_of`.
    """
    reduction = next((k for k in (8, 4, 2) if camera.width // k >= least_width), 1)
    if reduction == 1:
        return read_image_of(path, camera), camera
    image = _decode(path, REDUCED[reduction])
    height, width = image.shape[:2]
    if abs(width - camera.width / reduction) >= 1 or abs(height - camera.height / reduction) >= 1:
        read_image_of(path, camera)  # raises with the size of the image as stored
    # Scale by the exact reduction factor, even if the last row or column covers fewer pixels.
    smaller = dataclasses.replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx / reduction,
        fy=camera.fy / reduction,
        cx=(camera.cx + 0.5) / reduction - 0.5,
        cy=(camera.cy + 0.5) / reduction - 0.5,
    )
    return image, smaller
