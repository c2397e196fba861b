"""The video driver in its hosted process: recordings and live pipes that Pillow writes."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from drivers.errors import (
    DeviceFaultError,
    DeviceRefusedError,
    DeviceTimeoutError,
    DeviceUnavailableError,
    StaleImageError,
    UnreadableFileError,
)
from drivers.host.hosted_device import hosted
from drivers.interfaces import Camera, CameraSettings
from drivers.video import DRIVER, VideoConfig
from tests.support.vendor.mjpeg_writer import camera_on, jpeg

SET = CameraSettings(4.0, 0.01, 100)


@contextmanager
def opened(port: Path, **config: Any) -> Generator[Camera]:
    settings = VideoConfig.model_validate({"port": str(port), "aperture_f": 4.0, "exposure_s": 0.01} | config)
    camera = hosted(Camera, "drivers.video:DRIVER", settings, call_timeout_s=DRIVER.call_timeout_s, name="camera")
    try:
        camera.open()
        yield camera
    finally:
        camera.close()


def recording(path: Path, *files: bytes) -> Path:
    path.write_bytes(b"".join(files))
    return path


def capture_until_refused(camera: Camera, folder: Path) -> None:
    """What lies in the pipe is still read."""
    while True:
        camera.capture(folder)


@pytest.fixture
def pipe(tmp_path: Path) -> Path:
    path = tmp_path / "camera"
    os.mkfifo(path)
    return path


def test_a_recording_gives_its_own_files_one_after_another(tmp_path: Path) -> None:
    files = [jpeg(number) for number in range(4)]
    with opened(recording(tmp_path / "a.mjpeg", *files), serial="M 12", focal_length_mm=8) as camera:
        assert camera.apply(SET) == camera.settings() == SET
        seen = camera.preview()
        images = [camera.capture(tmp_path) for _ in files]
        with pytest.raises(DeviceRefusedError, match="no more images after 4"):
            camera.capture(tmp_path)
        assert camera.report().details["images"] == "the source's own JPEG files"
    assert seen == files[0]
    assert [image.jpeg.path.read_bytes() for image in images] == files
    assert [image.jpeg.sha256 for image in images] == [hashlib.sha256(file).hexdigest() for file in files]
    assert [image.counter for image in images] == [1, 2, 3, 4]
    first = images[0]
    assert (first.width, first.height, first.exif, first.exif_time) == (160, 120, SET, "")
    assert (first.body_serial, first.focal_length_mm) == ("M 12", 8.0)
    assert not list(tmp_path.glob("*.part"))


def test_a_source_of_pixels_is_written_as_jpeg(tmp_path: Path) -> None:
    greys = np.random.default_rng(1).integers(0, 255, (3, 120, 160), dtype=np.uint8)
    frames = [Image.fromarray(grey) for grey in greys]
    frames[0].save(tmp_path / "a.gif", save_all=True, append_images=frames[1:], duration=100)
    with opened(tmp_path / "a.gif") as camera:
        images = [camera.capture(tmp_path) for _ in frames]
        assert camera.report().details["images"] == "decoded, written as JPEG"
    for image, grey in zip(images, greys, strict=True):
        read = np.asarray(cv2.imread(str(image.jpeg.path), cv2.IMREAD_GRAYSCALE), dtype=float)
        assert np.abs(read - grey).max() <= 3.0


def test_a_live_image_was_exposed_after_the_call(pipe: Path, tmp_path: Path) -> None:
    with camera_on(pipe, tmp_path / "log"), opened(pipe, latency_s=0.2) as camera:
        calls: list[float] = []
        images = []
        for _ in range(3):
            calls.append(time.monotonic())
            images.append(camera.capture(tmp_path))
        assert camera.preview()[:2] == b"\xff\xd8"
        assert camera.report().problems == ()
    lines = [json.loads(line) for line in (tmp_path / "log").read_text().splitlines() if line.endswith("}")]
    written_s = {line["sha256"]: line["monotonic_s"] for line in lines}
    for called_s, image in zip(calls, images, strict=True):
        assert called_s <= image.trigger_monotonic_s < written_s[image.jpeg.sha256] <= image.arrival_monotonic_s


def test_a_frozen_camera_is_noticed(pipe: Path, tmp_path: Path) -> None:
    with camera_on(pipe, tmp_path / "log", frozen=True), opened(pipe, latency_s=0.0) as camera:
        camera.capture(tmp_path)
        with pytest.raises(StaleImageError, match="byte for byte"):
            camera.capture(tmp_path)


def test_a_camera_that_hangs_and_goes_on(pipe: Path, tmp_path: Path) -> None:
    with (
        camera_on(pipe, tmp_path / "log") as writer,
        opened(pipe, latency_s=0.0, frame_timeout_s=3.0) as camera,
    ):
        camera.capture(tmp_path)
        writer.send_signal(signal.SIGSTOP)
        try:
            with pytest.raises(DeviceTimeoutError, match="no image"):
                capture_until_refused(camera, tmp_path)
            assert "No image for" in camera.report().problems[0]
        finally:
            writer.send_signal(signal.SIGCONT)
        assert camera.capture(tmp_path).jpeg.size_bytes > 0


def test_a_camera_that_dies_and_one_that_comes_back(pipe: Path, tmp_path: Path) -> None:
    with camera_on(pipe, tmp_path / "log") as writer, opened(pipe, latency_s=0.0) as camera:
        camera.capture(tmp_path)
        writer.kill()
        with pytest.raises(DeviceUnavailableError, match="ended"):
            capture_until_refused(camera, tmp_path)
        assert camera.report().problems == ("The source has ended: open it again",)
        (tmp_path / "second").mkdir()
        with camera_on(pipe, tmp_path / "log2", first=1000):
            camera.open()
            again = camera.capture(tmp_path / "second")
    assert again.jpeg.sha256 in (tmp_path / "log2").read_text()


def test_a_pipe_into_which_nobody_writes_is_unavailable(pipe: Path) -> None:
    with pytest.raises(DeviceUnavailableError, match="Nobody writes"), opened(pipe, frame_timeout_s=0.5):
        pass


def test_damaged_images_are_not_used(tmp_path: Path) -> None:
    files = [jpeg(0), jpeg(1)[:-400], jpeg(2), jpeg(3, (80, 60))]
    with opened(recording(tmp_path / "a.mjpeg", *files)) as camera:
        camera.capture(tmp_path)
        with pytest.raises(UnreadableFileError, match="end marker"):
            camera.capture(tmp_path)
        assert camera.capture(tmp_path).jpeg.path.read_bytes() == files[2]
        with pytest.raises(UnreadableFileError, match="80 × 60 px"):
            camera.capture(tmp_path)


def test_settings_that_a_person_must_set_are_refused(tmp_path: Path) -> None:
    with opened(recording(tmp_path / "a.mjpeg", jpeg(0), jpeg(1))) as camera:
        with pytest.raises(DeviceRefusedError, match="f-number 22, not 4; ISO 800, not 100; RAW, not JPEG"):
            camera.apply(CameraSettings(22.0, 0.01, 800, "Manual", "RAW"))
        assert camera.released_images(tmp_path, 0.1) == ()


@pytest.mark.parametrize(("name", "words"), [("nothing", "no such"), ("words.txt", "cannot open")])
def test_what_is_no_source(tmp_path: Path, name: str, words: str) -> None:
    (tmp_path / "words.txt").write_text("no images in here")
    with pytest.raises(DeviceUnavailableError, match=words), opened(tmp_path / name):
        pass


def test_another_size_than_wanted_is_refused(tmp_path: Path) -> None:
    file = recording(tmp_path / "a.mjpeg", jpeg(0), jpeg(1))
    with (
        pytest.raises(DeviceFaultError, match="160 × 120 px instead of 640 × 480"),
        opened(file, width=640, height=480),
    ):
        pass
