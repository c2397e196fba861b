"""Reads photographs from files: only complete ones, with the pixels as stored."""

from __future__ import annotations

import dataclasses
import re
import zlib
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.core.errors import DataError

# In entropy-coded data 0xFF is followed by 0x00 (stuffing) or a restart marker; anything else ends the scan.
_END_OF_SCAN = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
_START_OF_SCAN, _END_OF_IMAGE = 0xDA, 0xD9
_FRAMES = {0xC0, 0xC1, 0xC2, 0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF}  # headers with the size
_JPEG = b"\xff\xd8"
_PNG = b"\x89PNG\r\n\x1a\n"
_MOST_PIXELS = 400_000_000  # three times the largest cameras; a damaged header may claim up to four gigabytes
_REDUCED = {8: cv2.IMREAD_REDUCED_COLOR_8, 4: cv2.IMREAD_REDUCED_COLOR_4, 2: cv2.IMREAD_REDUCED_COLOR_2}


def check_jpeg(data: bytes, where: str) -> None:
    """Check that a JPEG is complete, by walking its segments up to the end-of-image marker.

    Data after that marker (previews that cameras append) is allowed.

    Raises:
        DataError: the file is not a JPEG, or is truncated.
    """
    truncated = DataError(
        "the JPEG ends before its picture is complete",
        where=where,
        remedy="Copy the file from the camera again; a half-written image is not used",
    )
    if not data.startswith(_JPEG):
        raise DataError("this is not a JPEG file", where=where, remedy="Use JPEG or PNG images")
    at = 2
    while at + 2 <= len(data):
        if data[at] != 0xFF:
            raise DataError("the JPEG's structure is damaged", where=where, remedy="Copy the file again")
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        if marker == _END_OF_IMAGE:
            return
        if at + 4 > len(data):
            break
        if marker in _FRAMES:
            height, width = (int.from_bytes(data[at + k : at + k + 2], "big") for k in (5, 7))
            _check_size(width, height, where)
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        if marker == _START_OF_SCAN:
            end = _END_OF_SCAN.search(data, at)
            if end is None:
                break
            at = end.start()
    raise truncated


def check_png(data: bytes, where: str) -> None:
    """Check that a PNG is complete, by walking its chunks and their checksums to the end.

    Raises:
        DataError: the file is truncated or damaged.
    """
    _check_size(int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big"), where)
    at, kind = len(_PNG), b""
    while kind != b"IEND":
        length, kind = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8]
        end = at + 8 + length
        if end + 4 > len(data):  # a decoder would allocate the claimed length, up to four gigabytes
            raise DataError(
                "the PNG ends before its picture is complete",
                where=where,
                remedy="Copy the file again; a half-written image is not used",
            )
        if zlib.crc32(data[at + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            raise DataError("the PNG is damaged", where=where, remedy="Copy the file again")
        at = end + 4


def check_image(data: bytes, where: str, *, partly: bool = False) -> None:
    """Check a JPEG or PNG without decoding it; other formats are not checked. `partly` accepts a truncated JPEG.

    Raises:
        DataError: the file is truncated or damaged.
    """
    if data.startswith(_PNG):
        check_png(data, where)
    elif data.startswith(_JPEG) and not partly:
        check_jpeg(data, where)


def _check_size(width: int, height: int, where: str) -> None:
    if width * height > _MOST_PIXELS:
        raise DataError(
            f"the image claims to have {width} × {height} pixels",
            where=where,
            remedy="Copy the file from the camera again; no camera takes such images",
        )


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image as stored, after checking that it is complete; a JPEG is not decoded.

    Raises:
        DataError: as `read_image`.
    """
    if path.suffix.lower() in {".jpg", ".jpeg"}:
        try:
            data = path.read_bytes()
        except OSError as error:
            raise _unreadable(path, error) from error
        check_jpeg(data, str(path))
        size = _jpeg_size(data)
        if size is not None:
            return size
    height, width = read_grey(path).shape
    return width, height


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:
            at += 1
            continue
        if marker in _FRAMES:
            return int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big")
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return None


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
    try:
        data = path.read_bytes()
    except OSError as error:
        raise _unreadable(path, error) from error
    if path.suffix.lower() in {".jpg", ".jpeg"}:
        check_jpeg(data, str(path))
    else:
        check_image(data, str(path))
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), how | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise DataError(
            f"the image cannot be decoded: {error.err}", where=str(path), remedy="Copy the file from the camera again"
        ) from error
    if image is None:
        raise DataError(
            "the file is not an image that can be decoded", where=str(path), remedy="Use JPEG or PNG images"
        )
    return np.asarray(image, dtype=np.uint8)


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
    image = _decode(path, _REDUCED[reduction])
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
