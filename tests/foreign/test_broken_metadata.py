"""Whole pictures whose metadata are broken: they are taken, and what could not be read is said."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from drivers.errors import UnreadableFileError
from drivers.photos.photo_file import exiv2, read_exif
from drivers.photos.photo_folder import list_photographs
from service.compute.images.resample import described, with_metadata_of, without_personal_data
from service.import_folder import camera_record

EXIF, XMP = b"Exif\0\0", b"http://ns.adobe.com/xap/1.0/\0"
NOISE = np.random.default_rng(0).bytes(300)
APP1, APP2, APP13 = b"\xff\xe1", b"\xff\xe2", b"\xff\xed"
BROKEN = {
    "EXIF that is noise": (APP1, EXIF + NOISE),
    "EXIF whose directory lies behind its end": (APP1, EXIF + b"II*\0" + struct.pack("<I", 99999)),
    "IPTC that is noise": (APP13, b"Photoshop 3.0\0" + NOISE),
    "XMP that is noise": (APP1, XMP + NOISE),
    "a colour profile without content": (APP2, b"ICC_PROFILE\0"),
}


def _jpeg(marker: bytes = b"", content: bytes = b"") -> bytes:
    out = io.BytesIO()
    Image.fromarray(np.random.default_rng(1).integers(0, 255, (48, 64, 3), dtype=np.uint8)).save(out, "JPEG")
    data = out.getvalue()
    return data[:2] + (marker + struct.pack(">H", len(content) + 2) + content if marker else b"") + data[2:]


def _pixels(data: bytes) -> NDArray[np.uint8]:
    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), dtype=np.uint8)


@pytest.mark.parametrize("what", BROKEN)
def test_a_whole_photograph_is_imported_with_its_size(what: str, tmp_path: Path) -> None:
    (tmp_path / "DSC1.JPG").write_bytes(_jpeg(*BROKEN[what]))
    found = list_photographs(tmp_path)
    assert found.damaged == ()
    (photograph,) = found.photographs
    assert (photograph.exif.width, photograph.exif.height) == (64, 48)
    if what.startswith("EXIF"):
        assert "the photograph's EXIF is broken" in camera_record(photograph.exif)["unread"]
        with pytest.raises(UnreadableFileError, match="the photograph's EXIF is broken"):
            photograph.exif.settings(focus_mode="", image_quality="")


@pytest.mark.parametrize("what", BROKEN)
def test_a_photograph_is_exported_without_its_broken_metadata(what: str) -> None:
    data = _jpeg(*BROKEN[what])
    cleaned, marked = without_personal_data(data), described(data, "simulated")
    assert NOISE[:50] not in cleaned
    np.testing.assert_array_equal(_pixels(cleaned), _pixels(data))
    np.testing.assert_array_equal(_pixels(marked), _pixels(data))
    with Image.open(io.BytesIO(marked)) as picture:
        assert picture.getexif()[270] == "simulated"
    resampled = with_metadata_of(data, _jpeg(), personal=True)
    np.testing.assert_array_equal(_pixels(resampled), _pixels(_jpeg()))


@pytest.mark.parametrize(("key", "name"), [("FNumber", "aperture_f"), ("ISOSpeedRatings", "iso")])
def test_a_number_that_is_stated_as_text_is_not_the_code_of_its_first_letter(
    key: str, name: str, tmp_path: Path
) -> None:
    path = tmp_path / "a.jpg"
    path.write_bytes(_jpeg())
    image = exiv2.ImageFactory.open(str(path))
    image.readMetadata()
    image.exifData().add(exiv2.ExifKey(f"Exif.Photo.{key}"), exiv2.AsciiValue("f/22"))
    image.writeMetadata()
    assert getattr(read_exif(path), name) is None
