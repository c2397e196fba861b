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
    DeviceError,
    DeviceFaultError,
    DeviceRefusedError,
    DeviceUnavailableError,
    StaleImageError,
)
from drivers.gphoto.link import check_library_version
from drivers.gphoto.profile import choose_number, choose_word, number_of, quality_of
from drivers.gphoto.profiles.sony_ilce import PROFILE
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
    assert report.free_bytes is None, "no body lists a storage in PC Remote mode"
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


def test_stale_image_then_a_new_one(tmp_path: Path) -> None:
    with rig([{"on": "image", "kind": "stale", "nth": 2}]) as (camera, _):
        first = camera.capture(tmp_path)
        with pytest.raises(StaleImageError, match="DSC00001"):
            camera.capture(tmp_path)
        third = camera.capture(tmp_path)
    assert third.counter == 3
    assert hashlib.sha256(first.jpeg.path.read_bytes()).hexdigest() == first.jpeg.sha256


def test_shutter_refused_by_a_camera_that_answers(tmp_path: Path) -> None:
    with rig([{"on": "shutter", "kind": "reject"}]) as (camera, _):
        with pytest.raises(
            DeviceRefusedError,
            match=r"did not confirm .* no photograph came within 5 s.* if the shutter was released",
        ):
            camera.capture(tmp_path)
        assert camera.capture(tmp_path).counter == 1


@pytest.mark.parametrize("answer", [0x2002, 0x201D])  # a general error, and an invalid parameter
def test_a_release_that_is_not_confirmed_is_known_by_its_photograph(answer: int, tmp_path: Path) -> None:
    """Before, the exposure was called not taken, and the next one was given its photograph."""
    log = tmp_path / "truth.jsonl"
    fault = {"on": "shutter", "kind": "unconfirmed", "value": answer}
    with rig([fault], "--exposures-log", str(log)) as (camera, _):
        images = [camera.capture(tmp_path), camera.capture(tmp_path)]
    truth = [json.loads(line)["sha256"] for line in log.read_text().splitlines()]
    assert [image.counter for image in images] == [1, 2]
    assert [image.jpeg.sha256 for image in images] == truth


def test_setting_refused_for_good_and_for_a_moment() -> None:
    # The first set comes from the library itself when it connects (priority mode).
    with rig([{"on": "set", "kind": "reject", "nth": 2, "times": 1}]) as (camera, _):
        assert camera.apply(PAPER) == PAPER
    with (
        rig([{"on": "set", "kind": "ignore", "nth": 2, "times": 500}]) as (camera, _),
        pytest.raises(DeviceRefusedError, match="keeps f-number at f/8 instead of f/22"),
    ):
        camera.apply(CameraSettings(22.0, 1 / 15, 100, "Automatic"))


def test_camera_killed_and_started_again(tmp_path: Path) -> None:
    with camera_simulator() as simulator:
        camera = driver(simulator.gphoto_port)
        camera.open()
        camera.capture(tmp_path)
        simulator.process.send_signal(signal.SIGKILL)
        simulator.process.wait(90)
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


@pytest.mark.parametrize("version", ["2.5.30", "2.5.31", "2.5.27", "2.4.0", "banana"])
def test_unfit_library_versions_are_refused(version: str) -> None:
    with pytest.raises(DeviceFaultError, match="libgphoto2"):
        check_library_version(version)


@pytest.mark.parametrize("version", ["2.5.32", "2.5.33", "2.5.34", "2.6.0"])
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
    assert choose_word(PROFILE.quality, "JPEG", offered, "here") == "Extra Fine"
    assert choose_word(PROFILE.quality, "RAW+JPEG", offered, "here") == "RAW+JPEG (Fine)"
    assert [quality_of(word) for word in offered] == ["RAW", "RAW+JPEG", "JPEG", "JPEG"]
    with pytest.raises(DeviceRefusedError, match="offers no values"):
        choose_number(PROFILE.f_number, 22.0, ("--",), "here")
