"""Pictures under the name of another kind: their content decides, and one that cannot be read does not stop the rest.

Pixels are those that Pillow 13 reads from the same bytes. What is damaged in the middle of a JPEG, libjpeg says.
"""

from __future__ import annotations

import io
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from drivers.photos.photo_folder import list_photographs
from service.compute.images.photographs import image_folder, image_size, read_grey, read_image
from service.core.errors import DataError
from service.core.jpeg_damage import damaged_jpegs
from service.core.picture_files import kind_of
from tests.support.rig.rig import REPOSITORY

HEIC = b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(200)
AVIF = b"\0\0\0\x1cftypavif\0\0\0\0avifmif1miaf"
HTML = b"<!DOCTYPE html>\n<html><body>404 Not Found</body></html>"
POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"
FOREIGN = {"HEIC": HEIC, "text": HTML, "Git LFS pointer": POINTER, "PDF": b"%PDF-1.7\n", "JPEG XL": b"\xff\x0a\0\0"}


def _pixels() -> NDArray[np.uint8]:
    y, x = np.mgrid[0:48, 0:64]
    return np.stack([4 * x, 5 * y, 2 * (x + y)], axis=-1).astype(np.uint8)  # RGB, smooth


def _as(kind: str, **options: object) -> bytes:
    out = io.BytesIO()
    Image.fromarray(_pixels()).save(out, kind, **options)
    return out.getvalue()


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.webp", "a.tif"])
@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "TIFF", "BMP", "PPM"])
def test_a_picture_is_read_by_what_it_holds_whatever_its_name(kind: str, name: str, tmp_path: Path) -> None:
    options = {"lossless": True} if kind == "WEBP" else {}
    data = _as(kind, **options)
    (tmp_path / name).write_bytes(data)
    expected = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), dtype=np.int16)
    found = read_image(tmp_path / name)[..., ::-1].astype(np.int16)
    assert np.abs(found - expected).max() <= (3 if kind == "JPEG" else 0)  # two decoders of one JPEG
    assert image_size(tmp_path / name) == (64, 48)
    assert read_grey(tmp_path / name).shape == (48, 64)


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP"])
@pytest.mark.parametrize("name", ["a.jpg", "a.png"])
def test_a_truncated_picture_is_damaged_whatever_its_name(kind: str, name: str, tmp_path: Path) -> None:
    (tmp_path / "whole.png").write_bytes(_as("PNG"))
    (tmp_path / name).write_bytes(_as(kind)[:-40])
    with pytest.raises(DataError, match=f"1 of 2 images are damaged: {name}: the {kind}".replace("WEBP", "WebP")):
        image_folder(tmp_path)


@pytest.mark.parametrize("kind", FOREIGN)
def test_a_folder_of_images_goes_on_without_the_one_of_another_kind_and_names_it(kind: str, tmp_path: Path) -> None:
    (tmp_path / "good.jpg").write_bytes(_as("JPEG"))
    (tmp_path / "other.jpg").write_bytes(FOREIGN[kind])
    found = image_folder(tmp_path)
    assert [file.name for file in found.files] == ["good.jpg"]
    assert f"this is a {kind}" in found.left_out["other.jpg"]
    with pytest.raises(DataError, match=r"1 odd file: other\.jpg"):
        image_folder(tmp_path, strict=True)
    (tmp_path / "good.jpg").unlink()
    with pytest.raises(DataError, match=r"no image in this folder can be read; other\.jpg: this is a"):
        image_folder(tmp_path)


def test_a_folder_of_heic_files_is_not_called_empty(tmp_path: Path) -> None:
    (tmp_path / "IMG_0001.HEIC").write_bytes(HEIC)
    with pytest.raises(DataError, match=r"no image in this folder: IMG_0001\.HEIC is not of a kind that is read"):
        image_folder(tmp_path)


@pytest.mark.parametrize("kind", ["HEIC", "WebP", "PNG", "AVIF", "text"])
def test_photographs_of_another_kind_are_left_out_of_an_import_by_what_they_are(kind: str, tmp_path: Path) -> None:
    data = {"HEIC": HEIC, "WebP": _as("WEBP"), "PNG": _as("PNG"), "AVIF": AVIF, "text": HTML}[kind]
    (tmp_path / "DSC1.JPG").write_bytes(_as("JPEG"))
    (tmp_path / "DSC2.JPG").write_bytes(data)
    found = list_photographs(tmp_path)
    assert [one.file.path.name for one in found.photographs] == ["DSC1.JPG"]
    assert found.damaged == ()
    (left,) = found.left_out
    assert left.path.name == "DSC2.JPG"
    assert f" {kind}" in left.reason
    assert "not JPEG" in left.reason


@pytest.mark.parametrize("name", ["IMG_1.HEIC", "IMG_1.png", "IMG_1.jfif"])
def test_a_jpeg_under_another_name_is_imported(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(_as("JPEG"))
    assert [one.file.path.name for one in list_photographs(tmp_path).photographs] == [name]


def test_a_thumbnail_beside_a_film_is_no_photograph(tmp_path: Path) -> None:
    (tmp_path / "clip.thm").write_bytes(_as("JPEG"))
    shutil.copy(tmp_path / "clip.thm", tmp_path / "whole.jpg")
    assert [one.file.path.name for one in list_photographs(tmp_path).photographs] == ["whole.jpg"]


@pytest.mark.parametrize(
    ("data", "kind"),
    [
        (HEIC, "HEIC"),
        (b"\0\0\0\x1cftypmif1\0\0\0\0mif1heicmiaf", "HEIC"),
        (AVIF, "AVIF"),
        (b"\0\0\0\x1cftypmif1\0\0\0\0mif1avifmiaf", "AVIF"),
        (b"\0\0\0\x18ftypcrx \0\0\0\1crx isom", "raw file"),
        (b"\0\0\0\x18ftypmp42\0\0\0\0isommp42", "video"),
        (b"P5\n64 48\n255\n", "PNM"),
        (b"MM\0*\0\0\0\x08", "TIFF"),
        (b"\xff\xd8\xff\xe1", "JPEG"),
        (b"\xef\xbb\xbf  <html>", "text"),
        (b"", ""),
        (b"anything", ""),
    ],
)
def test_kinds_by_their_first_bytes(data: bytes, kind: str) -> None:
    assert kind_of(data) == kind


def _textured(**options: object) -> bytes:
    out = io.BytesIO()
    picture = np.random.default_rng(5).integers(60, 190, (24, 32, 3), dtype=np.uint8).repeat(8, 0).repeat(8, 1)
    Image.fromarray(picture).save(out, "JPEG", quality=92, **options)
    return out.getvalue()


def _spoilt(data: bytes, count: int) -> bytes:
    """Other bytes in the middle of the picture, none of which is a marker."""
    middle = len(data) // 2
    return (
        data[:middle]
        + bytes(np.random.default_rng(6).integers(1, 255, count, dtype=np.uint8))
        + data[middle + count :]
    )


@pytest.mark.parametrize("options", [{}, {"progressive": True}, {"restart_marker_rows": 2}], ids=str)
def test_a_jpeg_that_is_spoilt_in_the_middle_is_named(options: dict[str, object], tmp_path: Path) -> None:
    """A decoder goes on after the damage: the picture was taken, displaced and of another brightness below it."""
    whole = _textured(**options)
    (tmp_path / "DSC1.JPG").write_bytes(whole)
    (tmp_path / "DSC2.JPG").write_bytes(_spoilt(whole, 64))
    found = list_photographs(tmp_path)
    assert [one.file.path.name for one in found.photographs] == ["DSC1.JPG"]
    (damaged,) = found.damaged
    assert damaged.path.name == "DSC2.JPG"
    assert "its picture is damaged within" in damaged.reason
    with pytest.raises(DataError, match=r"1 of 2 images are damaged: DSC2\.JPG: its picture is damaged within"):
        image_folder(tmp_path)


@pytest.mark.parametrize("filling", [b"\0", b"\xff"])
def test_bytes_with_which_a_camera_fills_up_the_end_are_no_damage(filling: bytes, tmp_path: Path) -> None:
    (tmp_path / "DSC1.JPG").write_bytes(_textured()[:-2] + 16 * filling + b"\xff\xd9")
    assert list_photographs(tmp_path).damaged == ()


def test_a_file_with_which_the_decoder_ends_is_named_and_the_others_are_looked_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ending = tmp_path / "ending"
    ending.mkdir()
    (ending / "cv2.py").write_text(  # a decoder that a file brings down
        "import os\nIMREAD_REDUCED_GRAYSCALE_8 = 0\n"
        "def imdecode(data, how):\n    if b'ending' in data.tobytes():\n        os._exit(7)\n"
    )
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ending), os.environ.get("PYTHONPATH", str(REPOSITORY))]))
    files = [tmp_path / name for name in ("a.jpg", "b.jpg", "c.jpg", "gone.jpg")]
    for file, content in zip(files, (b"\xff\xd8", b"\xff\xd8 ending", b"\xff\xd8 ending"), strict=False):
        file.write_bytes(content)
    assert damaged_jpegs(files) == dict.fromkeys(
        files[1:3], "its picture cannot be decoded (the decoder ended with status 7)"
    )
