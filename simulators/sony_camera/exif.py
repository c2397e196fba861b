"""Encodes the camera's JPEG, and writes the EXIF of an ILCE-7RM5 into its files."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from simulators.serve import SimulatorError
from simulators.sony_camera.properties import ExposureSettings

exiv2: Any = importlib.import_module("exiv2")  # the library has no types
MAKE, MODEL, LENS = "SONY", "ILCE-7RM5", "FE 24-70mm F2.8 GM"
BODY_SERIAL, FIRMWARE = "05318008", "ILCE-7RM5 v3.00"
FOCAL_LENGTH_MM = 50
# JPEG level of the property table → (quality, chroma subsampling)
_LEVELS = {
    1: (97, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422),
    2: (94, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420),
    3: (88, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420),
    4: (80, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420),
}


@dataclass(frozen=True, slots=True)
class Shot:
    """The exposure data written into a file's EXIF."""

    settings: ExposureSettings
    counter: int
    taken: datetime  # with time zone


def encode_jpeg(picture: NDArray[np.uint8], shot: Shot) -> bytes:
    """Encode an RGB picture (H, W, 3) as JPEG with EXIF."""
    quality, sampling = _LEVELS[shot.settings.jpeg_quality]
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
        "Exif.Image.Make": MAKE,
        "Exif.Image.Model": MODEL,
        "Exif.Image.Software": FIRMWARE,
        "Exif.Image.DateTime": taken,
        "Exif.Photo.DateTimeOriginal": taken,
        "Exif.Photo.DateTimeDigitized": taken,
        "Exif.Photo.SubSecTimeOriginal": f"{shot.taken.microsecond // 1000:03d}",
        "Exif.Photo.OffsetTimeOriginal": f"{offset[:3]}:{offset[3:5]}",
        "Exif.Photo.LensModel": LENS,
        "Exif.Photo.BodySerialNumber": BODY_SERIAL,
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
