"""Files of cameras that send single frames instead of photographs: each is new, and all are of one size."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.errors import StaleImageError, UnreadableFileError
from drivers.interfaces import CapturedFile
from drivers.photos.photo_file import check_jpeg_complete, sha256_of

_JPEG = (cv2.IMWRITE_JPEG_QUALITY, 100, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)


def frame_jpeg(pixels: NDArray[np.uint8], where: str) -> bytes:
    """Pixels (H, W, 3) BGR or (H, W) grey as JPEG of quality 100 without chroma subsampling.

    Raises UnreadableFileError if they cannot be encoded.
    """
    done, encoded = cv2.imencode(".jpg", pixels, _JPEG)
    if not done:
        raise UnreadableFileError("an image cannot be encoded", where=where, remedy="Repeat the exposure")
    return encoded.tobytes()


class FrameFiles:
    """Writes the frames of one device, called `device` in messages, which is at `where`."""

    def __init__(self, device: str, where: str) -> None:
        self._device, self._where = device, where
        self._size: tuple[int, int] | None = None
        self._hashes: set[str] = set()

    def reopened(self) -> None:
        """The device was opened again and may have another size; its earlier frames stay known."""
        self._size = None

    def write(self, number: int, jpeg: bytes, folder: Path) -> CapturedFile:
        """Write a frame under its final name once it is complete. Raises UnreadableFileError if it is damaged."""
        target = folder / f"FRAME{number:06d}.JPG"
        partial = target.with_name(target.name + ".part")
        partial.write_bytes(jpeg)
        check_jpeg_complete(partial)
        partial.rename(target)
        return CapturedFile(target, target.name, sha256_of(target), len(jpeg), "image/jpeg")

    def accept(self, file: CapturedFile, size: tuple[int, int]) -> None:
        """Count a frame of this size (width, height in px).

        Raises:
            StaleImageError: it equals an earlier one bit for bit; no sensor repeats its noise.
            UnreadableFileError: it is of another size than those before it.
        """
        if file.sha256 in self._hashes:
            raise StaleImageError(
                f"{file.camera_name} is byte for byte the same as an earlier image",
                where=self._where,
                remedy=f"The {self._device} is frozen: open it again and repeat the exposure",
            )
        if self._size not in (None, size):
            raise UnreadableFileError(
                f"{file.camera_name} has {size[0]} × {size[1]} px, those before it another size",
                where=self._where,
                remedy=f"Calibration holds for one size: set the {self._device} back and repeat the exposure",
            )
        self._size = size
        self._hashes.add(file.sha256)
