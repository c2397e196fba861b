"""A camera without a cable: files that another process copies into a folder become photographs, each once."""

from __future__ import annotations

from pathlib import Path

import pytest

from drivers.errors import DeviceRefusedError, ReleasedElsewhereError, StaleImageError, UnreadableFileError
from drivers.interfaces import CameraSettings
from drivers.photo_watch import PhotoWatch, PhotoWatchConfig
from tests.support.record.stepped_clock import SteppedClock
from tests.support.rig.card import BEGAN, after, half_copied, photograph, put

SINCE_S = BEGAN.timestamp()


@pytest.fixture
def card(tmp_path: Path) -> Path:
    folder = tmp_path / "card"
    folder.mkdir()
    return folder


def watching(card: Path, **settings: float) -> PhotoWatch:
    """A camera that waits in virtual time."""
    clock = SteppedClock()
    config = PhotoWatchConfig.model_validate({"folder": card, "stable_s": 0.2, "stalled_s": 0.8} | settings)
    camera = PhotoWatch(config, clock.monotonic_s, clock.sleep)
    camera.open()
    return camera


def names(camera: PhotoWatch, folder: Path, wait_s: float = 1.0, since_s: float = SINCE_S) -> list[str]:
    return [image.jpeg.camera_name for image in camera.released_images(folder, wait_s, since_s)]


def test_a_half_copied_file_is_waited_for(card: Path, tmp_path: Path) -> None:
    camera = watching(card, stalled_s=30.0)
    data = photograph(1, after(1))
    with half_copied(card, "DSC00001.JPG", data):
        assert names(camera, tmp_path) == []
    (image,) = camera.released_images(tmp_path, 5.0, SINCE_S)
    assert image.jpeg.path.read_bytes() == data
    assert image.found_at == str(card / "DSC00001.JPG")
    assert image.exif == CameraSettings(22.0, 1 / 50, 100, "", "JPEG")
    assert image.counter == 1
    assert image.body_serial
    assert names(camera, tmp_path) == []


def test_a_card_that_is_put_in_later_comes_in_the_order_of_its_times(card: Path, tmp_path: Path) -> None:
    card.rmdir()
    camera = watching(card)
    assert "is not there yet" in camera.report().problems[0]
    assert names(camera, tmp_path, 0.3) == []
    card.mkdir()
    for name, seconds in (("DSC00003.JPG", 2.0), ("DSC00001.JPG", 3.0), ("IMG_2.jpeg", 1.0)):
        put(card, name, photograph(int(seconds), after(seconds)))
    assert names(camera, tmp_path, 5.0) == ["IMG_2.jpeg", "DSC00003.JPG", "DSC00001.JPG"]
    assert camera.report().details["photographs_from"] == str(card)
    assert camera.report().problems == ()


def test_while_one_file_arrives_those_that_are_there_wait(card: Path, tmp_path: Path) -> None:
    camera = watching(card, stalled_s=30.0)
    with half_copied(card, "DSC00001.JPG", photograph(1, after(1))):
        put(card, "DSC00002.JPG", photograph(2, after(2)))
        assert names(camera, tmp_path) == []
    assert names(camera, tmp_path, 5.0) == ["DSC00001.JPG", "DSC00002.JPG"]


@pytest.mark.slow
def test_the_same_bytes_are_taken_once(card: Path, tmp_path: Path) -> None:
    camera = watching(card)
    put(card, "DSC00001.JPG", photograph(1, after(1)))
    assert names(camera, tmp_path, 5.0) == ["DSC00001.JPG"]
    put(card, "DSC00001 (1).JPG", photograph(1, after(1)))
    assert names(camera, tmp_path) == []
    put(card, "DSC00002.JPG", photograph(2, after(2)))
    assert names(camera, tmp_path, 5.0) == ["DSC00002.JPG"]
    camera.open()
    assert names(camera, tmp_path, 5.0) == ["DSC00001 (1).JPG", "DSC00002.JPG"], "whoever asks knows what it has"


def test_a_file_that_stays_cut_off_is_told_once_and_holds_nothing_up(card: Path, tmp_path: Path) -> None:
    camera = watching(card)
    data = photograph(1, after(1))
    with half_copied(card, "DSC00001.JPG", data, whole=False):
        pass
    put(card, "DSC00002.JPG", photograph(2, after(2)))
    assert names(camera, tmp_path, 5.0) == ["DSC00002.JPG"]
    with pytest.raises(UnreadableFileError, match=r"DSC00001\.JPG"):
        camera.released_images(tmp_path, 1.0, SINCE_S)
    assert names(camera, tmp_path) == []
    put(card, "DSC00001.JPG", data)  # copied again
    assert names(camera, tmp_path, 5.0) == ["DSC00001.JPG"]


def test_a_file_that_is_spoilt_in_the_middle_is_told_once(card: Path, tmp_path: Path) -> None:
    camera = watching(card)
    data = photograph(1, after(1))
    end = len(data) - 2
    put(card, "DSC00001.JPG", data[: end - 40] + bytes(range(1, 33)) + data[end - 8 :])
    put(card, "DSC00002.JPG", photograph(2, after(2)))
    assert names(camera, tmp_path, 5.0) == ["DSC00002.JPG"]
    with pytest.raises(UnreadableFileError, match="its picture is damaged within") as told:
        camera.released_images(tmp_path, 1.0, SINCE_S)
    assert told.value.where.endswith("DSC00001.JPG")
    assert names(camera, tmp_path) == []


def test_what_was_taken_before_is_left_out(card: Path, tmp_path: Path) -> None:
    put(card, "DSC00001.JPG", photograph(1, after(-9000)))
    camera = watching(card)
    assert names(camera, tmp_path) == [], "it lay there: nobody needs to be told"
    for number in (2, 3):
        put(card, f"DSC0000{number}.JPG", photograph(number, after(-900 + number)))
    put(card, "DSC00004.JPG", photograph(4, after(4)))
    assert names(camera, tmp_path, 5.0) == ["DSC00004.JPG"]
    with pytest.raises(StaleImageError, match=r"^2 photographs are left out.*DSC00003\.JPG") as told:
        camera.released_images(tmp_path, 1.0, SINCE_S)
    assert "clock" in told.value.remedy
    assert names(camera, tmp_path) == []


def test_a_slow_clock_can_be_stated(card: Path, tmp_path: Path) -> None:
    camera = watching(card, clock_ahead_s=-3600.0)
    put(card, "DSC00001.JPG", photograph(1, after(-3599)))
    assert names(camera, tmp_path, 5.0) == ["DSC00001.JPG"]


def test_raw_and_jpeg_are_one_photograph(card: Path, tmp_path: Path) -> None:
    camera = watching(card, stalled_s=30.0)
    camera.apply(CameraSettings(22.0, 1 / 50, 100, "Manual", "RAW+JPEG"))
    put(card, "DSC00001.JPG", photograph(1, after(1)))
    assert names(camera, tmp_path) == []
    put(card, "DSC00001.ARW", photograph(1, after(1), raw=True))
    (image,) = camera.released_images(tmp_path, 5.0, SINCE_S)
    assert [file.media_type for file in image.files] == ["image/jpeg", "image/x-sony-arw"]
    assert image.exif.image_quality == "RAW+JPEG"


def test_raw_files_alone_are_told(card: Path, tmp_path: Path) -> None:
    camera = watching(card)
    put(card, "DSC00001.ARW", photograph(1, after(1), raw=True))
    with pytest.raises(UnreadableFileError, match="without the JPEG"):
        camera.released_images(tmp_path, 3.0, SINCE_S)
    assert names(camera, tmp_path) == []


def test_a_file_without_exif_is_told(card: Path, tmp_path: Path) -> None:
    camera = watching(card)
    put(card, "edited.jpg", bytes.fromhex("ffd8ffda0008010100003f00aaffd9"))
    with pytest.raises(UnreadableFileError):
        camera.released_images(tmp_path, 3.0, SINCE_S)
    assert names(camera, tmp_path) == []


def test_the_software_cannot_release_it(card: Path, tmp_path: Path) -> None:
    camera = watching(card)
    with pytest.raises(ReleasedElsewhereError, match="Press the camera's own button"):
        camera.capture(tmp_path)
    for ask in (camera.settings, camera.preview):
        with pytest.raises(DeviceRefusedError):
            ask()
