"""The GenICam driver in its hosted process, over GigE Vision on the loopback, against Aravis' own fake camera."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from drivers.errors import (
    DeviceFaultError,
    DeviceRefusedError,
    DeviceTimeoutError,
    DeviceUnavailableError,
    DriverMissingError,
)
from drivers.genicam import DRIVER, GenicamConfig, aravis
from drivers.genicam.link import Frame
from drivers.genicam.pixels import FORMATS, picture
from drivers.host.hosted_device import hosted
from drivers.interfaces import Camera, CameraSettings
from tests.support.processes.waiting import until

needs_aravis = pytest.mark.packages("aravis-tools")

SET = CameraSettings(8.0, 0.01, 100)


@contextmanager
def fake_camera(address: str, *words: str) -> Generator[subprocess.Popen[bytes]]:
    """Debian's arv-fake-gv-camera-0.8 (package aravis-tools) on an address of the loopback."""
    command = ["arv-fake-gv-camera-0.8", "-i", address, "-s", "GV77", *words]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@contextmanager
def opened(address: str, **config: Any) -> Generator[Camera]:
    settings = GenicamConfig.model_validate(
        {"camera": address, "aperture_f": 8.0, "pixel_format": "Mono8", "frame_timeout_s": 10.0} | config
    )
    camera = hosted(Camera, "drivers.genicam:DRIVER", settings, call_timeout_s=DRIVER.call_timeout_s, name="camera")
    answered: list[bool] = []

    def answers() -> bool:
        try:
            camera.open()
        except DeviceUnavailableError:
            return False
        answered.append(True)
        return True

    try:
        until(answers, "the fake camera does not answer")  # it says nothing when it begins to listen
        yield camera
    finally:
        camera.close()


@needs_aravis
def test_exposures_over_gige_vision(tmp_path: Path) -> None:
    with fake_camera("127.0.0.1"), opened("127.0.0.1", serial="GV77", gain=2.0) as camera:
        identity = camera.open()
        assert (identity.model, identity.serial) == ("Aravis Fake", "GV77")
        assert identity.driver_version.startswith("Aravis 0.8.")
        assert camera.apply(SET) == pytest.approx(SET)
        assert camera.apply(CameraSettings(8.0, 0.02, 100)).exposure_s == pytest.approx(0.02)
        before_s = time.monotonic()
        first, second = camera.capture(tmp_path), camera.capture(tmp_path)
        assert [image.counter for image in (first, second)] == [1, 2]
        assert first.files[0].sha256 != second.files[0].sha256
        assert before_s <= first.trigger_monotonic_s < first.arrival_monotonic_s <= second.trigger_monotonic_s
        assert (first.width, first.height, first.body_serial) == (512, 512, "GV77")
        assert first.exif.exposure_s == pytest.approx(0.02)
        written = cv2.imread(str(first.files[0].path), cv2.IMREAD_UNCHANGED)
        assert written is not None
        assert written.shape == (512, 512)
        assert camera.preview().startswith(b"\xff\xd8")
        details = camera.report().details
        assert (details["pixel format"], details["gain"], details["images taken"]) == ("Mono8", "2", "2")
        with pytest.raises(DeviceRefusedError, match=r"f-number 4, not 8; ISO 400, not 100"):
            camera.apply(CameraSettings(4.0, 0.01, 400))


@needs_aravis
def test_another_camera_is_refused() -> None:
    with (
        fake_camera("127.0.0.1"),
        pytest.raises(DeviceFaultError, match="serial number GV77, not GV78"),
        opened("127.0.0.1", serial="GV78"),
    ):
        pass


def test_without_aravis_the_message_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(aravis, "LIBRARIES", ("nothing-0.0", "gobject-2.0", "glib-2.0"))
    camera = DRIVER.build(GenicamConfig(camera="127.0.0.1", aperture_f=8.0))
    with pytest.raises(DriverMissingError, match=r"libnothing-0\.0 is not installed.*apt-get install libaravis"):
        camera.open()


@needs_aravis
def test_a_lost_camera_is_an_error_and_it_can_be_opened_again(tmp_path: Path) -> None:
    with fake_camera("127.0.0.1") as process, opened("127.0.0.1", frame_timeout_s=3.0) as camera:
        camera.capture(tmp_path)
        process.kill()
        process.wait()
        with pytest.raises((DeviceUnavailableError, DeviceTimeoutError)):
            camera.capture(tmp_path)
        with pytest.raises(DeviceUnavailableError):
            camera.open()
        with fake_camera("127.0.0.1"):
            until(lambda: _opens(camera), "it does not come back")
            camera.capture(tmp_path)


def _opens(camera: Camera) -> bool:
    try:
        camera.open()
    except DeviceUnavailableError:
        return False
    return True


@pytest.mark.parametrize("name", sorted(FORMATS))
def test_pixel_formats_give_their_colours(name: str) -> None:
    """A red picture is red, whichever photosite comes first."""
    red = np.zeros((8, 8, 3), dtype=np.uint8)
    red[..., 0] = 200
    channel = {"R": 0, "G": 1, "B": 2}
    if name == "RGB8":
        data = red.tobytes()
    elif name == "Mono8":
        data = bytes([90]) * 64
    else:
        first, second = name[5], name[6]
        others = {"RG": "GB", "GR": "BG", "GB": "RG", "BG": "GR"}[first + second]
        rows = np.array([[channel[first], channel[second]], [channel[others[0]], channel[others[1]]]])
        data = np.take_along_axis(red, np.tile(rows, (4, 4))[..., None], axis=2).tobytes()
    shown = picture(Frame(1, 8, 8, FORMATS[name][0], data), name)
    assert shown is not None
    middle = shown[4, 4]
    assert np.array_equal(middle, 90 if name == "Mono8" else [0, 0, 200])
    assert picture(Frame(1, 8, 8, 0x01100007, data), name) is None, "another format"
    assert picture(Frame(1, 8, 8, FORMATS[name][0], data[:-1]), name) is None, "half an image"
