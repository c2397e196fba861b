"""Encodes a camera's files: a JPEG with EXIF, and a small raw file."""

from __future__ import annotations

import importlib
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from simulators.serve import SimulatorError

exiv2: Any = importlib.import_module("exiv2")  # the library has no types
FOCAL_LENGTH_MM = 50
# Level of the JPEG → (quality, chroma subsampling)
_LEVELS = {
    1: (97, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422),
    2: (94, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420),
    3: (88, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420),
    4: (80, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420),
}


@dataclass(frozen=True, slots=True)
class ExposureSettings:
    """The settings with which an exposure is taken."""

    aperture_f: float
    exposure_s: float
    exposure_fraction: tuple[int, int]
    iso: int
    jpeg: bool = True
    raw: bool = False
    jpeg_level: int = 2  # 1 is the finest, 4 the coarsest
    on_card: bool = False  # the files stay on the card


@dataclass(frozen=True, slots=True)
class Nameplate:
    """What a body writes about itself into its files."""

    make: str
    model: str
    lens: str
    serial: str
    firmware: str
    sub_second_digits: int = 3


@dataclass(frozen=True, slots=True)
class Shot:
    """The exposure data written into a file's EXIF."""

    settings: ExposureSettings
    counter: int
    taken: datetime  # with time zone
    body: Nameplate


def encode_jpeg(picture: NDArray[np.uint8], shot: Shot) -> bytes:
    """Encode an RGB picture (H, W, 3) as JPEG with EXIF."""
    quality, sampling = _LEVELS[shot.settings.jpeg_level]
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling]
    done, encoded = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), options)
    if not done:
        raise SimulatorError("the picture could not be encoded as JPEG")
    return _with_exif(encoded.tobytes(), picture.shape[1], picture.shape[0], shot)


def _with_exif(file: bytes, width: int, height: int, shot: Shot) -> bytes:
    image = exiv2.ImageFactory.open(file)
    image.readMetadata()
    exif = image.exifData()
    settings = shot.settings
    taken = shot.taken.strftime("%Y:%m:%d %H:%M:%S")
    offset = shot.taken.strftime("%z")
    text = {
        "Exif.Image.Make": shot.body.make,
        "Exif.Image.Model": shot.body.model,
        "Exif.Image.Software": shot.body.firmware,
        "Exif.Image.DateTime": taken,
        "Exif.Photo.DateTimeOriginal": taken,
        "Exif.Photo.DateTimeDigitized": taken,
        "Exif.Photo.SubSecTimeOriginal": f"{shot.taken.microsecond:06d}"[: shot.body.sub_second_digits],
        "Exif.Photo.OffsetTimeOriginal": f"{offset[:3]}:{offset[3:5]}",
        "Exif.Photo.LensModel": shot.body.lens,
        "Exif.Photo.BodySerialNumber": shot.body.serial,
        "Exif.Photo.ImageUniqueID": f"{shot.taken:%Y%m%d%H%M%S%f}{shot.counter:012d}",
    }
    for key, value in text.items():
        exif[key] = exiv2.AsciiValue(value)
    exif["Exif.Photo.FNumber"] = exiv2.URationalValue((round(settings.aperture_f * 10), 10))
    exif["Exif.Photo.ExposureTime"] = exiv2.URationalValue(settings.exposure_fraction)
    exif["Exif.Photo.FocalLength"] = exiv2.URationalValue((FOCAL_LENGTH_MM * 10, 10))
    numbers = {
        "Exif.Image.Orientation": 1,
        "Exif.Photo.ExposureProgram": 1,
        "Exif.Photo.ISOSpeedRatings": settings.iso,
        "Exif.Photo.FocalLengthIn35mmFilm": FOCAL_LENGTH_MM,
    }
    for key, value in numbers.items():
        exif[key] = exiv2.UShortValue(value)
    exif["Exif.Photo.PixelXDimension"] = exiv2.ULongValue(width)
    exif["Exif.Photo.PixelYDimension"] = exiv2.ULongValue(height)
    image.writeMetadata()
    return bytes(image.io().data())


def encode_raw(picture: NDArray[np.uint8], shot: Shot) -> bytes:
    """Encode what stands for a raw file: a TIFF with camera tags and a 14-bit RGGB mosaic, a quarter as wide.

    It is no maker's real format: it has no maker notes, no tiled lossless compression, no embedded preview, no black
    level or white-balance tags, and a sixteenth of the pixels. It is a valid TIFF with the CFA tags of TIFF/EP, which
    is enough for a capture to pair, hash and recognise it.
    """
    mosaic = _mosaic(picture)
    height, width = mosaic.shape
    pixels = mosaic.tobytes()
    entries = [
        _number(254, _LONG, 0),
        _number(256, _LONG, width),
        _number(257, _LONG, height),
        _number(258, _SHORT, 16),
        _number(259, _SHORT, 1),
        _number(262, _SHORT, 32803),
        _text(271, shot.body.make),
        _text(272, shot.body.model),
        _number(_STRIP_OFFSETS, _LONG, 0),
        _number(274, _SHORT, 1),
        _number(277, _SHORT, 1),
        _number(278, _LONG, height),
        _number(279, _LONG, len(pixels)),
        _text(305, shot.body.firmware),
        _text(306, shot.taken.strftime("%Y:%m:%d %H:%M:%S")),
        _Entry(33421, _SHORT, 2, struct.pack("<HH", 2, 2)),
        _Entry(33422, _BYTE, 4, bytes([0, 1, 1, 2])),
    ]
    return _with_exif(_tiff(entries, pixels), width, height, shot)


def _mosaic(picture: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """The 14-bit RGGB mosaic of a picture, a quarter as wide."""
    small = cv2.resize(picture, (picture.shape[1] // 8 * 2, picture.shape[0] // 8 * 2), interpolation=cv2.INTER_AREA)
    linear = ((small / 255.0) ** 2.2 * 16383.0).astype("<u2")
    mosaic = linear[..., 1].copy()
    mosaic[0::2, 0::2] = linear[0::2, 0::2, 0]
    mosaic[1::2, 1::2] = linear[1::2, 1::2, 2]
    return mosaic


@dataclass(frozen=True, slots=True)
class _Entry:
    """An entry of a TIFF directory."""

    tag: int
    kind: int
    count: int
    data: bytes


_BYTE, _ASCII, _SHORT, _LONG = 1, 2, 3, 4  # kinds of TIFF values
_STRIP_OFFSETS = 273


def _number(tag: int, kind: int, value: int) -> _Entry:
    return _Entry(tag, kind, 1, struct.pack("<H" if kind == _SHORT else "<I", value))


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
