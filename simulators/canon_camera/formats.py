"""The image formats of a Canon EOS: as its events carry them, and as the numbers with which recordings name them."""

from __future__ import annotations

import struct
from dataclasses import dataclass

JPEG, RAW_FILE = 1, 6  # types of a file
CODES = range(0xD120, 0xD124)  # properties that hold image formats: of the body, and of each card
_RAW_BIT, _NO_FILE = 0x08, 0xFF
_SMALL_1 = 0x0E  # libgphoto2 numbers sizes from here on one lower, so that none is 15


@dataclass(frozen=True, slots=True)
class ImageFormat:
    """The files of an exposure: (type, size, compression) of one or two of them."""

    parts: tuple[tuple[int, int, int], ...]

    def encode(self) -> bytes:
        """Count, then for each file the size of its entry and the three numbers."""
        return struct.pack("<I", len(self.parts)) + b"".join(struct.pack("<IIII", 16, *part) for part in self.parts)


def of_number(number: int) -> ImageFormat:
    """The format of libgphoto2's number: a byte for each of two files, four bits of size and four of compression."""
    files = [byte for byte in (number >> 8 & 0xFF, number & 0xFF) if byte != _NO_FILE]
    return ImageFormat(
        tuple((RAW_FILE if byte & _RAW_BIT else JPEG, _size(byte >> 4), byte & 0x07) for byte in files)
    )


def _size(digit: int) -> int:
    return digit + 1 if digit >= _SMALL_1 - 1 else digit


JPEG_LARGE, JPEG_LARGE_NORMAL, RAW = (JPEG, 0, 3), (JPEG, 0, 2), (RAW_FILE, 0, 4)
_COMBINATIONS = ((JPEG_LARGE,), (JPEG_LARGE_NORMAL,), (RAW, JPEG_LARGE), (RAW, JPEG_LARGE_NORMAL), (RAW,))
FORMATS = tuple(ImageFormat(parts) for parts in _COMBINATIONS)
