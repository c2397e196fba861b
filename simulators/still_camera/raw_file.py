"""Writes the camera's raw file: the sensor's values as a DNG, under the name that the camera gives its raw files."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulators.rendering.sensor import BALANCE, BLACK, EXPOSED, SHIELDED, WHITE
from simulators.still_camera.exif import Shot, with_exif

# From XYZ to linear sRGB (IEC 61966-2-1): the sensor's filters see sRGB's primaries, each with its own strength.
_SRGB_OF_XYZ = ((3.2406, -1.5372, -0.4986), (-0.9689, 1.8758, 0.0415), (0.0557, -0.2040, 1.0570))
_D65 = 21  # an illuminant of EXIF
_CFA = 32803  # photometric interpretation of a mosaic


def encode_raw(mosaic: NDArray[np.uint16], shot: Shot) -> bytes:
    """Encode the sensor's values (H, W), RGGB, as `read_out` gives them.

    A maker's format has notes and a compression of its own. This is an uncompressed DNG (Adobe's specification 1.4):
    any raw developer opens it, and finds black and white level, white balance, the active area and the crop in it.
    """
    height, width = mosaic.shape
    left, top = SHIELDED.left, SHIELDED.top
    crop = (width - left - EXPOSED.left - EXPOSED.right, height - top - EXPOSED.top - EXPOSED.bottom)
    pixels = mosaic.astype("<u2").tobytes()
    matrix = [value / gain for row, gain in zip(_SRGB_OF_XYZ, BALANCE, strict=True) for value in row]
    entries = [
        _numbers(254, _LONG, 0),
        _numbers(256, _LONG, width),
        _numbers(257, _LONG, height),
        _numbers(258, _SHORT, 16),
        _numbers(259, _SHORT, 1),
        _numbers(262, _SHORT, _CFA),
        _text(271, shot.body.make),
        _text(272, shot.body.model),
        _numbers(_STRIP_OFFSETS, _LONG, 0),
        _numbers(274, _SHORT, 1),
        _numbers(277, _SHORT, 1),
        _numbers(278, _LONG, height),
        _numbers(279, _LONG, len(pixels)),
        _text(305, shot.body.firmware),
        _text(306, shot.taken.strftime("%Y:%m:%d %H:%M:%S")),
        _numbers(33421, _SHORT, 2, 2),  # repeat of the pattern
        _numbers(33422, _BYTE, 0, 1, 1, 2),  # RGGB
        _numbers(50706, _BYTE, 1, 4, 0, 0),  # version of DNG
        _numbers(50707, _BYTE, 1, 1, 0, 0),  # oldest version that reads it
        _text(50708, f"{shot.body.make} {shot.body.model}"),
        _numbers(50714, _SHORT, BLACK),
        _numbers(50717, _LONG, WHITE),
        _numbers(50719, _LONG, EXPOSED.left, EXPOSED.top),  # the crop's place in the active area
        _numbers(50720, _LONG, *crop),
        _ratios(50721, _SIGNED_RATIO, matrix),  # from XYZ to the sensor's colours
        _ratios(50728, _RATIO, [1 / gain for gain in BALANCE]),  # grey, in the sensor's colours
        _numbers(50778, _SHORT, _D65),
        _numbers(50829, _LONG, top, left, height, width),  # the active area
    ]
    return with_exif(_tiff(entries, pixels), *crop, shot)


@dataclass(frozen=True, slots=True)
class _Entry:
    """An entry of a TIFF directory."""

    tag: int
    kind: int
    count: int
    data: bytes


_BYTE, _ASCII, _SHORT, _LONG, _RATIO, _SIGNED_RATIO = 1, 2, 3, 4, 5, 10  # kinds of TIFF values
_STRIP_OFFSETS = 273
_PACKED = {_BYTE: "B", _SHORT: "H", _LONG: "I"}
_DENOMINATOR = 10_000


def _numbers(tag: int, kind: int, *values: int) -> _Entry:
    return _Entry(tag, kind, len(values), struct.pack(f"<{len(values)}{_PACKED[kind]}", *values))


def _ratios(tag: int, kind: int, values: Sequence[float]) -> _Entry:
    sign = "i" if kind == _SIGNED_RATIO else "I"
    parts = [part for value in values for part in (round(value * _DENOMINATOR), _DENOMINATOR)]
    return _Entry(tag, kind, len(values), struct.pack(f"<{len(parts)}{sign}", *parts))


def _text(tag: int, value: str) -> _Entry:
    data = value.encode("ascii") + b"\0"
    return _Entry(tag, _ASCII, len(data), data)


def _tiff(entries: Sequence[_Entry], pixels: bytes) -> bytes:
    """A little-endian TIFF with one directory and one strip of pixels, whose place is filled in."""
    directory_bytes = 2 + 12 * len(entries) + 4
    extra_at = 8 + directory_bytes
    pixels_at = extra_at + sum(len(e.data) + len(e.data) % 2 for e in entries if len(e.data) > 4)
    directory, extra = struct.pack("<H", len(entries)), b""
    for entry in entries:
        data = struct.pack("<I", pixels_at) if entry.tag == _STRIP_OFFSETS else entry.data
        if len(data) > 4:
            field = struct.pack("<I", extra_at + len(extra))
            extra += data + b"\0" * (len(data) % 2)
        else:
            field = data.ljust(4, b"\0")
        directory += struct.pack("<HHI", entry.tag, entry.kind, entry.count) + field
    return b"II*\0" + struct.pack("<I", 8) + directory + struct.pack("<I", 0) + extra + pixels
