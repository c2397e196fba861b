"""Decodes photographs for people: reduced, and rotated if asked for. Nothing is measured in these."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.images.decode import REDUCED, decode
from service.core.errors import DataError
from service.core.picture_files import check_picture, picture_size

_MOST_PIXELS = 250_000_000
_REMEDY = "Download the recorded file and look at it; it is kept unchanged as evidence"


def decode_reduced(
    content: bytes, width_px: int, name: str, *, upright: bool = False
) -> tuple[NDArray[np.uint8], int]:
    """A JPEG or PNG as (H, W, 3) BGR, at most `width_px` wide, and its width as stored.

    It is decoded at an eighth, a quarter or half of its size if that is wide enough, because 60 MP take long.

    Args:
        content: of the file.
        width_px: narrower pictures keep their width.
        name: of the file, for messages.
        upright: rotate by the orientation tag; otherwise the pixels are as stored, like those that are measured.

    Raises:
        DataError: it is not a picture that can be decoded, or has too many pixels to show.
    """
    stored_px, rows = picture_size(content, name)
    if stored_px * rows > _MOST_PIXELS:
        raise DataError(
            f"the picture has {stored_px} × {rows} pixels, which is too many to show", where=name, remedy=_REMEDY
        )
    check_picture(content, name, partly=True)
    how = next((flag for k, flag in REDUCED.items() if stored_px // k >= width_px), cv2.IMREAD_COLOR)
    image = decode(content, how if upright else how | cv2.IMREAD_IGNORE_ORIENTATION, name=name, remedy=_REMEDY)
    height, width = image.shape[:2]
    if width > width_px:
        image = cv2.resize(image, (width_px, max(1, round(height * width_px / width))), interpolation=cv2.INTER_AREA)
    return np.asarray(image, dtype=np.uint8), stored_px
