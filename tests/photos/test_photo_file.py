"""EXIF and completeness of photograph files from several manufacturers."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import skimage
from PIL import Image

from drivers.errors import UnreadableFileError
from drivers.photos.photo_file import check_jpeg_complete, exiv2, read_exif, sha256_of

SHIPPED = sorted((Path(skimage.__file__).parent / "data").glob("*.jpg"))
EXIF_IFD = 0x8769


def photograph(path: Path, *, image: dict[int, object], photo: dict[int, object], progressive: bool = False) -> Path:
    pixels = np.random.default_rng(1).integers(0, 255, (40, 60, 3), dtype=np.uint8)
    exif = Image.Exif()
    exif.update(image)
    exif.get_ifd(EXIF_IFD).update(photo)
    Image.fromarray(pixels).save(path, exif=exif, progressive=progressive)
    return path


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_pictures_without_exif_are_read_and_say_so(path: Path) -> None:
    record = read_exif(path)
    assert (record.make, record.aperture_f, record.taken, record.orientation) == ("", None, "", 1)
    with Image.open(path) as image:
        assert (record.width, record.height) == image.size
    check_jpeg_complete(path)
    with pytest.raises(UnreadableFileError, match="does not state"):
        record.settings(focus_mode="Manual", image_quality="JPEG")


def sony(path: Path, focus_position: int) -> Path:
    """A JPEG with the maker note in which Sony's ILCE bodies state their focus, enciphered as in a camera."""
    Image.new("RGB", (90, 60), (90, 120, 80)).save(path, "JPEG")
    image = exiv2.ImageFactory.open(str(path))
    image.readMetadata()
    exif = image.exifData()
    exif["Exif.Image.Make"], exif["Exif.Image.Model"] = "SONY", "ILCE-7RM5"
    for key, value in (("FocusMode", 0), ("FocusPosition2", focus_position)):
        number = exiv2.Value.create(exiv2.TypeId.unsignedByte)
        number.read(str(value))
        exif.add(exiv2.ExifKey(f"Exif.Sony2Fp.{key}"), number)
    image.setExifData(exif)
    image.writeMetadata()
    return path


def test_there_are_pictures_that_others_made() -> None:
    assert len(SHIPPED) >= 2


def test_a_canon(tmp_path: Path) -> None:
    path = photograph(
        tmp_path / "IMG_0001.JPG",
        image={271: "Canon", 272: "Canon EOS R5", 274: 6},
        photo={
            33437: 5.6,
            33434: 1 / 125,
            34855: 400,
            37386: 85.0,
            36867: "2025:01:02 03:04:05",
            42036: "RF85mm",
            42037: "L-77",
            37382: 0.75,
        },
    )
    record = read_exif(path)
    assert (record.lens_serial, record.focus_distance_m) == ("L-77", pytest.approx(0.75))
    assert (record.make, record.model, record.lens) == ("Canon", "Canon EOS R5", "RF85mm")
    assert (record.aperture_f, record.iso, record.focal_length_mm) == (pytest.approx(5.6), 400, 85.0)
    assert record.exposure_s == pytest.approx(1 / 125)
    assert (record.orientation, record.taken) == (6, "2025:01:02 03:04:05")
    assert record.settings(focus_mode="Manual", image_quality="JPEG").iso == 400


def test_a_sony_states_how_it_was_focused(tmp_path: Path) -> None:
    first, second = (sony(tmp_path / f"{position}.jpg", position) for position in (117, 0))
    for path, position in ((first, 117), (second, 0)):
        record = read_exif(path)
        assert (record.focus_mode, record.focus_position) == ("Manual", position)
    with Image.open(first) as picture:
        picture.save(tmp_path / "bare.jpg")
    record = read_exif(tmp_path / "bare.jpg")
    assert (record.focus_mode, record.focus_position) == ("", None)


def test_time_with_fraction_and_offset_and_a_silent_lens(tmp_path: Path) -> None:
    photo: dict[int, object] = {36867: "2026:11:21 04:00:00", 37521: "123", 36881: "+01:00", 33437: (0, 0)}
    record = read_exif(photograph(tmp_path / "a.jpg", image={271: "NIKON"}, photo=photo))
    assert record.taken == "2026:11:21 04:00:00.123+01:00"
    assert record.aperture_f is None


@pytest.mark.parametrize("content", [b"", b"not a picture", b"\xff\xd8"], ids=["empty", "text", "two bytes"])
def test_no_picture_at_all(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "broken.jpg"
    path.write_bytes(content)
    with pytest.raises(UnreadableFileError, match=r"broken\.jpg"):
        read_exif(path)
    with pytest.raises(UnreadableFileError, match=r"broken\.jpg"):
        check_jpeg_complete(path)


@pytest.mark.parametrize("progressive", [False, True])
def test_cut_off_jpeg(tmp_path: Path, progressive: bool) -> None:
    path = photograph(tmp_path / "DSC00001.JPG", image={271: "SONY"}, photo={}, progressive=progressive)
    check_jpeg_complete(path)
    whole = path.read_bytes()
    # A preview appended after the image, as by Sony, is not damage.
    path.write_bytes(whole + whole)
    check_jpeg_complete(path)
    for kept in (len(whole) - 2, len(whole) // 2, 30, 3):
        path.write_bytes(whole[:kept])
        with pytest.raises(UnreadableFileError, match=r"DSC00001\.JPG"):
            check_jpeg_complete(path)


def test_thumbnail_in_exif_does_not_count_as_the_picture(tmp_path: Path) -> None:
    thumbnail = io.BytesIO()
    Image.new("RGB", (8, 8)).save(thumbnail, "JPEG")
    path = tmp_path / "a.jpg"
    Image.new("RGB", (64, 64)).save(path, "JPEG", exif=b"Exif\0\0" + thumbnail.getvalue())
    whole = path.read_bytes()
    path.write_bytes(whole[:-2])
    with pytest.raises(UnreadableFileError, match="end marker"):
        check_jpeg_complete(path)


def test_sha256(tmp_path: Path) -> None:
    path = tmp_path / "abc"
    path.write_bytes(b"abc")
    assert sha256_of(path) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
