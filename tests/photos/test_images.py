"""Damaged images are refused with a message before a decoder allocates the memory that they claim."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from drivers.errors import UnreadableFileError
from drivers.photos.photo_file import check_jpeg_complete
from service.compute.images.photographs import image_size, read_grey
from service.core.errors import DataError
from service.core.picture_files import picture_size
from service.web.images import reduced_jpeg

PICTURE = np.random.default_rng(3).integers(0, 255, (32, 48), dtype=np.uint8)


@pytest.fixture
def png() -> bytes:
    whole, data = cv2.imencode(".png", PICTURE)
    assert whole
    return data.tobytes()


def test_a_whole_png_is_read(tmp_path: Path, png: bytes) -> None:
    (tmp_path / "a.png").write_bytes(png)
    assert (read_grey(tmp_path / "a.png") == PICTURE).all()


@pytest.mark.parametrize("kept", [0.1, 0.5, 0.99])
def test_a_truncated_png_is_refused(tmp_path: Path, png: bytes, kept: float) -> None:
    (tmp_path / "a.png").write_bytes(png[: int(kept * len(png))])
    with pytest.raises(DataError, match="the PNG ends before its picture is complete"):
        read_grey(tmp_path / "a.png")


def test_a_png_with_a_changed_byte_is_refused(tmp_path: Path, png: bytes) -> None:
    changed = bytearray(png)
    changed[len(png) // 2] ^= 4
    (tmp_path / "a.png").write_bytes(changed)
    with pytest.raises(DataError, match="the PNG is damaged"):
        read_grey(tmp_path / "a.png")


def test_a_png_that_claims_gigabytes_is_refused_at_once(tmp_path: Path, png: bytes) -> None:
    """A decoder once allocated four gigabytes, which took 14 s (found by bench/torture/fuzz)."""
    claims = png[:33] + b"\xff\xda\x00\x12IDAT" + png[41:]
    (tmp_path / "a.png").write_bytes(claims)
    with pytest.raises(DataError, match="the PNG ends before its picture is complete"):
        read_grey(tmp_path / "a.png")
    with pytest.raises(DataError, match="the PNG ends before its picture is complete"):
        reduced_jpeg(tmp_path / "a.png", 40)


def jpeg(*, progressive: bool) -> bytes:
    how = [cv2.IMWRITE_JPEG_PROGRESSIVE, int(progressive), cv2.IMWRITE_JPEG_RST_INTERVAL, 4]
    whole, data = cv2.imencode(".jpg", PICTURE, how)
    assert whole
    return data.tobytes()


@pytest.mark.parametrize("progressive", [False, True])
def test_every_reader_of_a_jpeg_judges_it_alike(tmp_path: Path, progressive: bool) -> None:
    """The driver that fetches it and what computes with it or shows it: cut anywhere, or damaged, none takes it."""
    whole, path = jpeg(progressive=progressive), tmp_path / "a.jpg"
    path.write_bytes(whole + whole)  # a preview behind the picture is no damage
    check_jpeg_complete(path)
    assert image_size(path) == picture_size(whole) == (48, 32)
    assert read_grey(path).shape == (32, 48)
    damaged = whole.replace(b"\xff\xc4", b"\x00\xc4", 1)
    for content in (*(whole[:kept] for kept in range(len(whole) - 1)), damaged):
        path.write_bytes(content)
        for read, refusal in ((check_jpeg_complete, UnreadableFileError), (image_size, DataError)):
            with pytest.raises(refusal):
                read(path)
