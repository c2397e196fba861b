"""Pictures of a report: small copies of recorded images, each verified by its hash first."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from service.audit.record.run import RecordedRun
from service.audit.report.blocks import Picture
from service.core.errors import IntegrityError

THUMBNAIL_PX = 240
LARGE_PX = 720
_QUALITY = 76  # so that a report of 36 photographs stays under 3 MB


def picture(run: RecordedRun, sha256: str, caption: str, width_px: int, *, upright: bool = False) -> Picture:
    """A JPEG copy of limited width without the camera's metadata; empty if the file is missing or altered.

    `upright`: rotate by the orientation tag. Images that are measured are never rotated.
    """
    try:
        path = run.files.artefact_path(sha256, verify=True)
    except IntegrityError:
        return Picture(f"{caption}: the file is missing or was altered", None)
    pixels = _read(path, width_px, 0 if upright else cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None:
        return Picture(f"{caption}: the file cannot be read as a picture", None)
    height, width = pixels.shape[:2]
    if width > width_px:
        size = (width_px, round(height * width_px / width))
        pixels = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA))
    jpeg = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
    return Picture(caption, jpeg, pixels.shape[1], pixels.shape[0], sha256)


def _read(path: Path, width_px: int, how: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]] | None:
    """Decode an image; at a quarter of its size if that is enough, because 60 MP take long otherwise."""
    if width_px <= THUMBNAIL_PX:
        small = cv2.imread(str(path), cv2.IMREAD_REDUCED_COLOR_4 | how)
        if small is not None and small.shape[1] >= width_px:
            return np.asarray(small, dtype=np.uint8)
    found = cv2.imread(str(path), cv2.IMREAD_COLOR | how)
    return None if found is None else np.asarray(found, dtype=np.uint8)
