"""The camera driver in its hosted child process, against the simulated camera."""

from __future__ import annotations

import hashlib
import json
import signal
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from drivers.errors import (
    DeviceBusyError,
    DeviceError,
    DeviceFaultError,
    DeviceRefusedError,
    DeviceStorageFullError,
    DeviceTimeoutError,
    DeviceUnavailableError,
    StaleImageError,
    UnreadableFileError,
)
from drivers.gphoto.link import check_library_version
from drivers.gphoto.profile import choose_number, choose_word, number_of, quality_of
from drivers.gphoto.profiles.sony_ilce import SONY_ILCE
from drivers.interfaces import Camera, CameraSettings
from tests.support.rig.camera_simulator import camera_simulator
from tests.support.rig.gphoto_rig import PAPER, driver, gphoto_rig

rig = partial(gphoto_rig, "camera")


@pytest.fixture(scope="module")
def camera() -> Iterator[Camera]:
    with rig() as (device, _):
        yield device


def test_identity_and_report(camera: Camera) -> None:
    report = camera.report()
    assert (report.identity.model, report.identity.serial) == ("ILCE-7RM5", "3282933005318008")
    assert "libgphoto2 2." in report.identity.driver_version
    assert report.battery_fraction == pytest.approx(0.87)
    assert report.free_bytes is not None
    assert report.free_bytes > 1e9
    assert report.problems == ()


def test_settings_are_applied_and_read_back(camera: Camera) -> None:
    assert camera.apply(PAPER) == PAPER
    assert camera.settings() == PAPER
    other = CameraSettings(8.0, 3.2, 400, "Automatic", "RAW+JPEG")
    assert camera.apply(other) == other
    assert camera.apply(PAPER) == PAPER


def test_a_setting_that_the_camera_lacks_is_refused_with_its_neighbours(camera: Camera) -> None:
    with pytest.raises(DeviceRefusedError, match="f/22") as refused:
        camera.apply(CameraSettings(23.7, 1 / 15, 100))
    assert "f-number 23.7" in refused.value.what
    with pytest.raises(DeviceRefusedError, match="focusmode Telepathic"):
        camera.apply(CameraSettings(22.0, 1 / 15, 100, "Telepathic"))


def test_files_are_those_that_left_the_camera_and_advance(tmp_path: Path) -> None:
    log = tmp_path / "truth.jsonl"
    with rig([], "--exposures-log", str(log)) as (camera, _):
        camera.apply(PAPER)
        first = camera.capture(tmp_path)
        camera.apply(CameraSettings(22.0, 1 / 15, 100, "Manual", "RAW+JPEG"))
        second = camera.capture(tmp_path)
        report = camera.report()
    truth = [json.loads(line) for line in log.read_text().splitlines()]
    assert [first.counter, second.counter] == [1, 2]
    assert first.exif_time < second.exif_time
    assert [first.jpeg.sha256, second.jpeg.sha256] == [line["sha256"] for line in truth]
    assert hashlib.sha256(first.jpeg.path.read_bytes()).hexdigest() == first.jpeg.sha256
    assert [file.camera_name for file in second.files] == ["DSC00002.JPG", "DSC00002.ARW"]
    assert [file.media_type for file in second.files] == ["image/jpeg", "image/x-sony-arw"]
    assert (first.exif.aperture_f, first.exif.exposure_s, first.exif.iso) == (22.0, pytest.approx(1 / 15), 100)
    assert (first.lens, first.focal_length_mm) == ("FE 24-70mm F2.8 GM", 50.0)
    assert 0 < first.arrival_monotonic_s - first.trigger_monotonic_s < 30
    assert report.clock_offset_s == pytest.approx(0.0, abs=5.0)


def test_raw_alone(tmp_path: Path) -> None:
    with rig() as (camera, _):
        camera.apply(CameraSettings(22.0, 1 / 15, 100, "Manual", "RAW"))
        image = camera.capture(tmp_path)
    assert [file.camera_name for file in image.files] == ["DSC00001.ARW"]
    assert image.exif.aperture_f == 22.0


def test_live_view(camera: Camera) -> None:
    frame = camera.preview()
    assert frame[:2] == b"\xff\xd8"
    assert frame[-2:] == b"\xff\xd9"


def test_live_view_waits_for_a_busy_camera() -> None:
    with rig([{"on": "preview", "kind": "busy", "times": 2}]) as (camera, _):
        assert camera.preview()[:2] == b"\xff\xd8"


def test_stale_image_then_a_new_one(tmp_path: Path) -> None:
    with rig([{"on": "image", "kind": "stale", "nth": 2}]) as (camera, _):
        first = camera.capture(tmp_path)
        with pytest.raises(StaleImageError, match="DSC00001"):
            camera.capture(tmp_path)
        third = camera.capture(tmp_path)
    assert third.counter == 3
    assert hashlib.sha256(first.jpeg.path.read_bytes()).hexdigest() == first.jpeg.sha256


def test_stale_image_is_known_by_its_bytes_in_another_folder(tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    with rig([{"on": "image", "kind": "stale", "nth": 2}]) as (camera, _):
        camera.capture(tmp_path)
        with pytest.raises(StaleImageError, match="byte for byte"):
            camera.capture(other)


@pytest.mark.parametrize("on", ["image", "get_object"])
def test_truncated_jpeg_is_named_and_earlier_files_are_untouched(tmp_path: Path, on: str) -> None:
    with rig([{"on": on, "kind": "truncate", "nth": 2}]) as (camera, _):
        first = camera.capture(tmp_path)
        with pytest.raises(UnreadableFileError, match=r"DSC00002\.JPG.*not affected"):
            camera.capture(tmp_path)
        third = camera.capture(tmp_path)
    assert sorted(path.name for path in tmp_path.glob("*.JPG")) == ["DSC00001.JPG", "DSC00003.JPG"]
    assert hashlib.sha256(first.jpeg.path.read_bytes()).hexdigest() == first.jpeg.sha256
    assert third.counter == 3


def test_busy_camera_is_asked_again(tmp_path: Path) -> None:
    with rig([{"on": "shutter", "kind": "busy", "times": 2}]) as (camera, _):
        assert camera.capture(tmp_path).counter == 1


def test_camera_that_stays_busy(tmp_path: Path) -> None:
    with rig([{"on": "shutter", "kind": "busy", "times": 50}]) as (camera, _), pytest.raises(DeviceBusyError):
        camera.capture(tmp_path)


def test_full_store(tmp_path: Path) -> None:
    with rig([{"on": "shutter", "kind": "disk_full"}]) as (camera, _):
        with pytest.raises(DeviceStorageFullError):
            camera.capture(tmp_path)
        assert any("free" in problem for problem in camera.report().problems)


def test_shutter_refused_by_a_camera_that_answers(tmp_path: Path) -> None:
    with rig([{"on": "shutter", "kind": "reject"}]) as (camera, _):
        with pytest.raises(DeviceRefusedError, match="did not release"):
            camera.capture(tmp_path)
        assert camera.capture(tmp_path).counter == 1


def test_setting_refused_for_good_and_for_a_moment() -> None:
    # The first set comes from the library itself when it connects (priority mode).
    with rig([{"on": "set", "kind": "reject", "nth": 2, "times": 1}]) as (camera, _):
        assert camera.apply(PAPER) == PAPER
    with (
        rig([{"on": "set", "kind": "ignore", "nth": 2, "times": 500}]) as (camera, _),
        pytest.raises(DeviceRefusedError, match="keeps f-number at f/8 instead of f/22"),
    ):
        camera.apply(CameraSettings(22.0, 1 / 15, 100, "Automatic"))


def test_shutter_without_an_image(tmp_path: Path) -> None:
    with rig([{"on": "image", "kind": "no_image"}], capture_timeout_s=2.0) as (camera, _):
        with pytest.raises(DeviceTimeoutError, match="none"):
            camera.capture(tmp_path)
        assert camera.capture(tmp_path).counter == 2


@pytest.mark.parametrize("kind", ["drop", "reset"])
def test_link_lost_in_mid_download_then_open_again(tmp_path: Path, kind: str) -> None:
    with rig([{"on": "get_object", "kind": kind, "nth": 2}]) as (camera, _):
        first = camera.capture(tmp_path)
        with pytest.raises(DeviceUnavailableError):
            camera.capture(tmp_path)
        camera.open()
        third = camera.capture(tmp_path)
    assert third.counter == 3
    assert hashlib.sha256(first.jpeg.path.read_bytes()).hexdigest() == first.jpeg.sha256


def test_camera_killed_and_started_again(tmp_path: Path) -> None:
    with camera_simulator() as simulator:
        camera = driver(simulator.gphoto_port)
        camera.open()
        camera.capture(tmp_path)
        simulator.process.send_signal(signal.SIGKILL)
        simulator.process.wait(10)
        try:
            with pytest.raises(DeviceError):
                camera.capture(tmp_path)
            with pytest.raises(DeviceUnavailableError):
                camera.open()
            with camera_simulator((), "--first-counter", "2", port=simulator.port):
                camera.open()
                assert camera.capture(tmp_path).counter == 2
        finally:
            camera.close()


def test_nobody_listens() -> None:
    camera = driver("ptpip:127.0.0.1:9")
    with pytest.raises(DeviceUnavailableError, match=r"127\.0\.0\.1"):
        camera.open()
    camera.close()


@pytest.mark.parametrize("version", ["2.5.31", "2.5.27", "2.4.0", "banana"])
def test_unfit_library_versions_are_refused(version: str) -> None:
    with pytest.raises(DeviceFaultError, match="libgphoto2"):
        check_library_version(version)


@pytest.mark.parametrize("version", ["2.5.30", "2.5.32", "2.5.34", "2.6.0"])
def test_fit_library_versions(version: str) -> None:
    check_library_version(version)


@pytest.mark.parametrize(
    ("word", "number"),
    [("f/22", 22.0), ("1/15", 1 / 15), ("32/10", 3.2), ("100", 100.0), ("Bulb", None), ("1/0", None)],
)
def test_numbers_in_the_camera_s_words(word: str, number: float | None) -> None:
    assert number_of(word) == (None if number is None else pytest.approx(number))


def test_words_of_another_usb_mode() -> None:
    offered = ("RAW", "RAW+JPEG (Fine)", "Extra Fine", "Fine")
    assert choose_word(SONY_ILCE.quality, "JPEG", offered, "here") == "Extra Fine"
    assert choose_word(SONY_ILCE.quality, "RAW+JPEG", offered, "here") == "RAW+JPEG (Fine)"
    assert [quality_of(word) for word in offered] == ["RAW", "RAW+JPEG", "JPEG", "JPEG"]
    with pytest.raises(DeviceRefusedError, match="offers no values"):
        choose_number(SONY_ILCE.f_number, 22.0, ("--",), "here")
