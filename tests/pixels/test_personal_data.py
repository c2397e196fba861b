"""Photographs keep their EXIF; what names a person or a place is removed on demand, and the pixels stay."""

from __future__ import annotations

import importlib
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image
from PIL.ExifTags import IFD, Base

from service.compute.images.resample import with_metadata_of, without_personal_data
from service.core.errors import DataError

exiv2: Any = importlib.import_module("exiv2")

PERSONAL = {
    "Exif.Photo.BodySerialNumber": "BODY-50071",
    "Exif.Photo.LensSerialNumber": "LENS-1807",
    "Exif.Photo.CameraOwnerName": "Erika Muster",
    "Exif.Image.Artist": "Max Beispiel",
    "Exif.GPSInfo.GPSLatitudeRef": "N",
    "Exif.GPSInfo.GPSMapDatum": "Balgrist-84",
}
KEPT = {"Exif.Image.Model": "ILCE-7RM5", "Exif.Photo.DateTimeOriginal": "2026:11:23 10:00:00"}
XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description xmlns:aux="http://ns.adobe.com/exif/1.0/aux/" aux:SerialNumber="BODY-50071"/>'
    "</rdf:RDF></x:xmpmeta>"
)


def jpeg(width: int = 64, height: int = 48) -> bytes:
    pixels = np.random.default_rng(1).integers(0, 255, (height, width, 3), dtype=np.uint8)
    return cv2.imencode(".jpg", pixels)[1].tobytes()


@pytest.fixture
def photograph() -> bytes:
    image = exiv2.ImageFactory.open(jpeg())
    image.readMetadata()
    exif = image.exifData()
    for key, value in (PERSONAL | KEPT).items():
        exif[key] = exiv2.AsciiValue(value)
    exif["Exif.Image.Orientation"] = exiv2.UShortValue(6)
    exif["Exif.Photo.PixelXDimension"] = exiv2.UShortValue(64)
    image.setXmpPacket(XMP)
    image.writeMetadata()
    preview = jpeg(16, 12) + b"BODY-50071"
    return bytes(image.io().mmap()) + preview


def tags(data: bytes, tmp_path: Any) -> dict[int, Any]:
    """Every tag as Pillow, a reader that is not exiv2, finds it."""
    file = tmp_path / "picture.jpg"
    file.write_bytes(data)
    with Image.open(file) as picture:
        exif = picture.getexif()
        return {**exif, **exif.get_ifd(IFD.Exif), **exif.get_ifd(IFD.GPSInfo)}


def test_nothing_personal_stays_and_the_pixels_do(photograph: bytes, tmp_path: Any) -> None:
    cleaned = without_personal_data(photograph)
    for value in PERSONAL.values():
        assert value.encode() in photograph
        assert value == "N" or value.encode() not in cleaned
    found = tags(cleaned, tmp_path)
    assert found[Base.Model] == KEPT["Exif.Image.Model"]
    assert found[Base.DateTimeOriginal] == KEPT["Exif.Photo.DateTimeOriginal"]
    assert not {Base.BodySerialNumber, Base.LensSerialNumber, Base.CameraOwnerName, Base.Artist} & set(found)
    assert not {1, Base.GPSInfo} & set(found)
    before, after = (cv2.imdecode(np.frombuffer(d, np.uint8), cv2.IMREAD_IGNORE_ORIENTATION | 1)
                     for d in (photograph, cleaned))  # fmt: skip
    assert (before == after).all()


def test_a_serial_number_hidden_in_another_segment_is_refused(photograph: bytes) -> None:
    segment = b"\xff\xe9\x00\x0cBODY-50071"
    with pytest.raises(DataError, match="repeats a serial number"):
        without_personal_data(photograph[:2] + segment + photograph[2:])


@pytest.mark.parametrize("personal", [True, False])
def test_a_resampled_picture_has_the_metadata_and_its_own_size(
    photograph: bytes, tmp_path: Any, personal: bool
) -> None:
    found = tags(with_metadata_of(photograph, jpeg(32, 24), personal=personal), tmp_path)
    assert found[Base.Model] == KEPT["Exif.Image.Model"]
    assert found[Base.ExifImageWidth] == 32
    assert found[Base.Orientation] == 1
    assert (found.get(Base.BodySerialNumber) == "BODY-50071") is personal
    assert (found.get(Base.CameraOwnerName) == "Erika Muster") is personal


def test_what_is_no_picture_is_refused() -> None:
    with pytest.raises(DataError):
        without_personal_data(b"not a picture at all")
