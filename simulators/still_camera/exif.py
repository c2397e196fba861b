"""Encodes a camera's JPEG, and writes EXIF into its files."""

from __future__ import annotations

import importlib
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
    states_aperture: bool = True  # not without a lens, or with one that has no contacts


@dataclass(frozen=True, slots=True)
class Nameplate:
    """Holds what a body writes about itself into its files."""

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
    return with_exif(encoded.tobytes(), picture.shape[1], picture.shape[0], shot)


def with_exif(file: bytes, width: int, height: int, shot: Shot) -> bytes:
    """The file with the EXIF of the shot, for a picture of this size in pixels."""
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
    if settings.states_aperture:
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
