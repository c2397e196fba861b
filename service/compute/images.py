"""Photographs from files: whole ones only, as the sensor saw them."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from service.core.errors import DataError

# In entropy-coded data 0xFF is followed by 0x00 (stuffing) or a restart marker; anything else ends the scan.
_END_OF_SCAN = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
_START_OF_SCAN, _END_OF_IMAGE = 0xDA, 0xD9


def check_jpeg(data: bytes, where: str) -> None:
    """Walk the segments of a JPEG up to its end-of-image marker.

    What cameras append behind that marker (previews) is allowed.

    Raises:
        DataError: the file is not a JPEG, or ends before its picture does.
    """
    truncated = DataError(
        "the JPEG ends before its picture is complete",
        where=where,
        remedy="Copy the file from the camera again; a half-written image is not used",
    )
    if data[:2] != b"\xff\xd8":
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
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        if marker == _START_OF_SCAN:
            end = _END_OF_SCAN.search(data, at)
            if end is None:
                break
            at = end.start()
    raise truncated


def read_image(path: Path) -> NDArray[np.uint8]:
    """(H, W, 3) BGR as stored: the orientation tag is ignored, so that the camera model fits.

    Raises:
        DataError: the file is missing, truncated, or no image that can be decoded.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"the image cannot be read: {error.strerror}", where=str(path)) from error
    if path.suffix.lower() in {".jpg", ".jpeg"} or data[:2] == b"\xff\xd8":
        check_jpeg(data, str(path))
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise DataError(f"the image cannot be decoded: {error.err}", where=str(path)) from error
    if image is None:
        raise DataError(
            "the file is not an image that can be decoded", where=str(path), remedy="Use JPEG or PNG images"
        )
    return np.asarray(image, dtype=np.uint8)
