"""Pictures of a report: small copies of recorded images, each verified by its hash first."""

from __future__ import annotations

import cv2

from service.audit.record.run import RecordedRun
from service.audit.report.blocks import Picture
from service.compute.images.photographs import decode_reduced
from service.core.errors import DataError, IntegrityError

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
    try:
        pixels, _ = decode_reduced(path.read_bytes(), width_px, path.name, upright=upright)
    except DataError:
        return Picture(f"{caption}: the file cannot be read as a picture", None)
    jpeg = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
    return Picture(caption, jpeg, pixels.shape[1], pixels.shape[0], sha256)
