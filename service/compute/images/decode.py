"""Decodes picture files with OpenCV, as stored or reduced; an error names the file and what to do."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from service.core.errors import DataError

#: OpenCV's flag by the reduction of width and height: the decoder then does a part of the work only.
REDUCED = {8: cv2.IMREAD_REDUCED_COLOR_8, 4: cv2.IMREAD_REDUCED_COLOR_4, 2: cv2.IMREAD_REDUCED_COLOR_2}


def decode(content: bytes, how: int, *, name: str, remedy: str) -> NDArray[np.uint8]:
    """(H, W, 3) BGR or (H, W) of a picture file.

    Args:
        content: of the file, which has been checked (service.core.picture_files).
        how: flags of cv2.imdecode.
        name: of the file, for the error.
        remedy: what the reader of the error should do.

    Raises:
        DataError: OpenCV cannot decode it.
    """
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), how)
    except cv2.error as error:
        raise DataError(f"the image cannot be decoded: {error.err}", where=name, remedy=remedy) from error
    if image is None:
        raise DataError("the image cannot be decoded", where=name, remedy=remedy)
    return np.asarray(image, dtype=np.uint8)
