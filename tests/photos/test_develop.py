"""Raw files become linear pictures of fixed brightness in the place of their JPEG, or are refused by name."""

from __future__ import annotations

import hashlib
import json
import struct
import sys
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage
from typer.testing import CliRunner

from service.cli.main import app
from service.compute.images.develop import Developed, coded, develop, eight_bits, find_shift, read_developed
from service.core.errors import ConfigurationError, DataError
from simulators.rendering.sensor import EXPOSED, bordered, camera_picture, read_out
from simulators.sony_camera.exif import PLATE
from simulators.still_camera.exif import ExposureSettings, Shot, encode_jpeg
from simulators.still_camera.raw_file import encode_raw

SETTINGS = ExposureSettings(22.0, 1 / 15, (1, 15), 100)
WIDTH, HEIGHT = 480, 320
CROP_ORIGIN, CROP_SIZE, UNKNOWN = 50719, 50720, 65000  # tags of DNG, and one of nobody's


def leaves(seed: int = 3) -> NDArray[np.uint8]:
    """An RGB picture with edges in every direction, all over it."""
    rng = np.random.default_rng(seed)
    picture = np.full((HEIGHT, WIDTH, 3), 90, dtype=np.uint8)
    for _ in range(400):
        middle = tuple(int(v) for v in rng.uniform(0, 1, 2) * (WIDTH, HEIGHT))
        colour = tuple(int(v) for v in rng.integers(30, 225, 3))
        cv2.ellipse(picture, middle, (14, 6), float(rng.uniform(0, 180)), 0, 360, colour, -1, cv2.LINE_AA)
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.8), dtype=np.uint8)


def exposure(folder: Path, picture: NDArray[np.uint8], name: str = "DSC00001") -> tuple[Path, Path]:
    """The raw file and the JPEG of one exposure."""
    mosaic = read_out(bordered(picture), 100, 1)
    shot = Shot(SETTINGS, 1, datetime(2026, 11, 24, tzinfo=UTC), PLATE)
    raw, jpeg = folder / f"{name}.ARW", folder / f"{name}.JPG"
    raw.write_bytes(encode_raw(mosaic, shot))
    jpeg.write_bytes(encode_jpeg(camera_picture(mosaic), shot))
    return raw, jpeg


def read_bgr(path: Path) -> NDArray[np.uint8]:
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    assert picture is not None
    return np.asarray(picture, dtype=np.uint8)


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path]:
    return exposure(tmp_path, leaves())


def test_brightness_is_that_of_the_light_whatever_the_picture_shows(tmp_path: Path) -> None:
    linear = {10: 0.0030352698, 60: 0.0451862044, 128: 0.2158605001, 200: 0.5775804404}  # IEC 61966-2-1
    patches = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
    for column, level in enumerate(linear):
        patches[:, column * 120 : column * 120 + 120] = level
    made = develop(exposure(tmp_path, patches)[0], None)
    for column, light in enumerate(linear.values()):
        patch = made.image_bgr[:, column * 120 + 20 : column * 120 + 100] / 65535
        assert patch.mean(axis=(0, 1)) == pytest.approx(np.full(3, light), abs=2e-4 + 4e-3 * light)
    dark = develop(exposure(tmp_path, np.full_like(patches, 10))[0], None)
    assert dark.image_bgr.mean() / 65535 == pytest.approx(linear[10], abs=2e-4), "nothing brightens a dark picture"
    assert made.how.white_balance[:3] == pytest.approx((2.1, 1.0, 1.6), abs=1e-3)
    assert (made.how.black_level, made.how.white_level) == ((512,) * 4, 16383)


def test_the_picture_lies_where_the_jpeg_shows_it(pair: tuple[Path, Path]) -> None:
    raw, jpeg = pair
    made = develop(raw, read_bgr(jpeg))
    assert made.image_bgr.shape == (HEIGHT, WIDTH, 3)
    assert made.how.area == (WIDTH + EXPOSED.left + EXPOSED.right, HEIGHT + EXPOSED.top + EXPOSED.bottom)
    assert (made.how.crop.left, made.how.crop.top, made.how.crop.found) == (EXPOSED.left, EXPOSED.top, "file")
    assert made.how.shift_px == pytest.approx((0.0, 0.0), abs=0.03)
    difference = eight_bits(coded(made.image_bgr)).astype(float) - read_bgr(jpeg)
    assert np.median(np.abs(difference)) < 4
    assert np.array_equal(develop(raw, read_bgr(jpeg)).image_bgr, made.image_bgr), "the same file, the same picture"


@pytest.mark.slow
@pytest.mark.parametrize("found", ["matched", "moved"])
def test_a_crop_that_is_missing_or_wrong_is_found_by_the_jpeg(pair: tuple[Path, Path], found: str) -> None:
    raw, jpeg = pair
    data = bytearray(raw.read_bytes())
    origin, size = (data.index(struct.pack("<HHI", tag, 4, 2)) for tag in (CROP_ORIGIN, CROP_SIZE))
    if found == "matched":
        struct.pack_into("<H", data, size, UNKNOWN)
    else:
        (place,) = struct.unpack_from("<I", data, origin + 8)
        struct.pack_into("<II", data, place, EXPOSED.left + 4, EXPOSED.top - 6)
    raw.write_bytes(data)
    made = develop(raw, read_bgr(jpeg))
    assert (made.how.crop.left, made.how.crop.top, made.how.crop.found) == (EXPOSED.left, EXPOSED.top, found)


def warped(jpeg: Path, change: str) -> NDArray[np.uint8]:
    """The JPEG as a camera, or a person, might have changed it."""
    picture = read_bgr(jpeg)
    if change == "distortion corrected":
        x, y = np.meshgrid(np.linspace(-1, 1, WIDTH), np.linspace(-1, 1, HEIGHT))
        stretch = 1 - 0.006 * (x**2 + y**2)
        at = [((a * stretch + 1) * (n - 1) / 2).astype(np.float32) for a, n in ((x, WIDTH), (y, HEIGHT))]
        return np.asarray(cv2.remap(picture, at[0], at[1], cv2.INTER_CUBIC), dtype=np.uint8)
    if change == "half a pixel":
        by = np.array([[1, 0, 0.5], [0, 1, 0.5]], dtype=np.float32)
        return np.asarray(cv2.warpAffine(picture, by, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC), dtype=np.uint8)
    if change == "smaller":
        return np.asarray(cv2.resize(picture, (WIDTH // 2, HEIGHT // 2)), dtype=np.uint8)
    return leaves(seed=4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("distortion corrected", r"up to 0\.\d+ px.*distortion compensation"),
        pytest.param("half a pixel", r"up to 0\.[67]\d px", marks=pytest.mark.sweep),
        pytest.param("smaller", "240 × 160.*full size", marks=pytest.mark.sweep),
        pytest.param("another picture", "do not show the same picture", marks=pytest.mark.sweep),
    ],
)
def test_a_jpeg_that_is_not_the_same_picture_is_refused(pair: tuple[Path, Path], change: str, words: str) -> None:
    with pytest.raises(DataError, match=words):
        develop(pair[0], warped(pair[1], change))


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.999])
def test_half_a_raw_file_is_refused_by_name(pair: tuple[Path, Path], share: float) -> None:
    data = pair[0].read_bytes()
    pair[0].write_bytes(data[: int(share * len(data))])
    with pytest.raises(DataError, match=r"cannot be developed.*DSC00001\.ARW"):
        develop(pair[0], None)


def test_without_rawpy_the_message_names_the_extra(pair: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rawpy", None)
    with pytest.raises(ConfigurationError, match=r"orthocapture\[raw\]"):
        develop(pair[0], None)


@pytest.mark.parametrize("shift_px", [(0.25, -0.4), (3.0, -2.0), (-11.3, 7.6)])
def test_shifts_are_found_to_hundredths_of_a_pixel(shift_px: tuple[float, float]) -> None:
    grey = np.asarray(cv2.cvtColor(leaves(), cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    moved = ndimage.shift(grey.astype(float), (shift_px[1], shift_px[0]), order=5, mode="reflect")
    darker = np.rint(0.6 * moved + 20).astype(np.uint8)
    found = find_shift(grey, darker)
    assert found.certain
    assert found.median_px == pytest.approx(shift_px, abs=0.02)
    assert not find_shift(grey, np.full_like(grey, 128)).certain


@pytest.mark.slow
def test_the_command_writes_a_tiff_and_its_record(pair: tuple[Path, Path], tmp_path: Path) -> None:
    raw, jpeg = pair
    words = ["develop", str(raw), "--out", str(tmp_path / "out")]
    shown = CliRunner().invoke(app, words, catch_exceptions=False)
    assert shown.exit_code == 0, shown.output
    assert "480 × 320 px" in shown.output
    tiff = tmp_path / "out" / "DSC00001.tif"
    record = json.loads(tiff.with_suffix(".json").read_text())
    for part, path in (("raw", raw), ("jpeg", jpeg), ("tiff", tiff)):
        assert record[part] == {"name": path.name, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    assert record["parameters"]["gamma"] == [1.0, 1.0]
    assert record["libraw"].count(".") == 2
    made: Developed = develop(raw, read_bgr(jpeg))
    assert np.array_equal(read_developed(tiff), made.image_bgr)
    again = CliRunner().invoke(app, words, catch_exceptions=False)
    assert again.exit_code == 1
    assert "exists" in again.output
    jpeg.unlink()
    alone = CliRunner().invoke(app, [*words[:-1], str(tmp_path / "alone"), "--demosaic", "AHD", "--json"])
    assert json.loads(alone.output)[0]["shift_px"] is None
    assert json.loads(alone.output)[0]["parameters"]["demosaic"] == "AHD"
    unknown = CliRunner().invoke(app, [*words[:-1], str(tmp_path / "other"), "--demosaic", "magic"])
    assert unknown.exit_code == 1
    assert "magic" in unknown.output
