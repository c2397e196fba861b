"""The GenICam driver in its hosted process against the simulated GigE Vision camera: by Aravis, and by harvesters.

harvesters loads a GenTL producer of our own, which is compiled here.
"""

from __future__ import annotations

import os
import time
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.errors import (
    DeviceRefusedError,
    DeviceTimeoutError,
    DeviceUnavailableError,
    StaleImageError,
)
from drivers.genicam import DRIVER, GenicamConfig
from drivers.host.hosted_device import hosted
from drivers.interfaces import Camera, CameraSettings
from simulators.still_camera.exif import ExposureSettings
from simulators.still_camera.scene import Moment, StillLife
from tests.support.rig.gentl_producer import ADDRESS_VARIABLE, compiled_producer, industrial_camera

pytestmark = pytest.mark.packages("aravis-tools", "gcc", "libc6-dev")

HOST, FAULTY = "127.0.0.62", "127.0.0.63"
SET = CameraSettings(22.0, 1 / 15, 100)


@pytest.fixture(scope="module")
def producer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled_producer(tmp_path_factory.mktemp("gentl"))


@pytest.fixture(params=["Aravis", "harvesters"])
def way(request: pytest.FixtureRequest, producer: Path) -> dict[str, str]:
    """The keys of rig.yaml that choose the library."""
    return {"producer": str(producer)} if request.param == "harvesters" else {}


@pytest.fixture(scope="module")
def camera_on() -> Generator[None]:
    """A camera without faults, for all tests that ask for it."""
    with industrial_camera(HOST):
        yield


@contextmanager
def opened(way: dict[str, str], host: str = HOST, **config: Any) -> Generator[Camera]:
    os.environ[ADDRESS_VARIABLE] = host  # of the child that is started next
    settings = GenicamConfig.model_validate(
        {"camera": host, "serial": "22334455", "aperture_f": 22.0, "frame_timeout_s": 10.0, **way, **config}
    )
    camera = hosted(Camera, "drivers.genicam:DRIVER", settings, call_timeout_s=DRIVER.call_timeout_s, name="camera")
    try:
        camera.open()
        yield camera
    finally:
        camera.close()


def pixels(path: Path) -> NDArray[np.uint8]:
    read = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert read is not None
    return np.asarray(read, dtype=np.uint8)


@pytest.mark.usefixtures("camera_on")
def test_settings_and_exposures(way: dict[str, str], tmp_path: Path) -> None:
    with opened(way, gain=6.04) as camera:
        identity = camera.open()  # again: the camera lets go and is taken back
        assert (identity.model, identity.serial) == ("Orthocapture GE-1", "22334455")
        assert identity.driver_version.startswith("harvesters 1." if way else "Aravis 0.8.")
        assert camera.apply(SET).exposure_s == pytest.approx(66_667e-6, abs=1e-9)  # its steps are microseconds
        before_s = time.monotonic()
        first, second = camera.capture(tmp_path), camera.capture(tmp_path)
        assert before_s <= first.trigger_monotonic_s < first.arrival_monotonic_s <= second.trigger_monotonic_s
        assert first.arrival_monotonic_s - first.trigger_monotonic_s >= 0.066  # it exposed that long
        assert (first.width, first.height, first.body_serial) == (480, 320, "22334455")
        assert camera.preview().startswith(b"\xff\xd8")
        details = camera.report().details
        assert (details["pixel format"], details["gain"]) == ("BayerRG8", "6")
        with pytest.raises(DeviceRefusedError, match="instead of 3 s"):
            camera.apply(CameraSettings(22.0, 3.0, 100))
        # Another program does not get the camera, and does not disturb this one.
        told = "not allowed" if way else "another program controls it"
        with pytest.raises(DeviceUnavailableError, match=f"{told}.*Close other programs"), opened(way):
            pass
        assert camera.capture(tmp_path).jpeg.size_bytes > 0


@pytest.mark.usefixtures("camera_on")
@pytest.mark.parametrize("name", ["Mono8", "BayerRG8", pytest.param("RGB8", marks=pytest.mark.sweep)])
def test_the_picture_is_what_the_camera_saw(name: str, way: dict[str, str], tmp_path: Path) -> None:
    with opened(way, pixel_format=name) as camera:
        camera.apply(SET)
        shown = pixels(camera.capture(tmp_path).jpeg.path).astype(float)
    settings = ExposureSettings(22.0, 1 / 15, (1, 15), 100)
    seen = cv2.cvtColor(StillLife(480).develop(Moment(1, None, {}), settings), cv2.COLOR_RGB2BGR)
    if name == "Mono8":
        seen = cv2.cvtColor(seen, cv2.COLOR_BGR2GRAY)
    apart = np.abs(shown - seen)[: shown.shape[0] * 4 // 5]  # below is the number of the image
    assert apart.max() <= 4.0 if name != "BayerRG8" else apart.mean() < 2.0  # the edges of a mosaic are guessed


def test_faults_of_the_link_and_of_the_camera(way: dict[str, str], tmp_path: Path) -> None:
    faults = [
        {"kind": kind, "nth": number} for number, kind in ((2, "lost_packets"), (3, "truncate"), (4, "no_image"))
    ]
    with (
        industrial_camera(FAULTY, faults=(*faults, {"kind": "stale", "nth": 6})),
        opened(way, FAULTY, frame_timeout_s=6.0) as camera,
    ):
        first, second = (pixels(camera.capture(tmp_path).jpeg.path).astype(float) for _ in range(2))
        assert np.abs(first - second)[:200].max() <= 2.0  # lost packets were sent again; only the number differs
        for _ in ("an image that stays incomplete", "none at all"):
            with pytest.raises(DeviceTimeoutError, match="no whole image"):
                camera.capture(tmp_path)
        assert camera.capture(tmp_path).counter == 3
        with pytest.raises(StaleImageError, match="byte for byte"):
            camera.capture(tmp_path)


def test_packets_that_come_late_make_a_whole_image(way: dict[str, str], tmp_path: Path) -> None:
    """As on a machine that is busy; Aravis itself waits for 0.1 s."""
    with (
        industrial_camera(FAULTY, faults=({"kind": "stall", "nth": 1, "value": 0.5},)),
        opened(way, FAULTY) as camera,
    ):
        assert camera.capture(tmp_path).counter == 1


def test_half_of_the_packets_are_asked_for_again(way: dict[str, str], tmp_path: Path) -> None:
    """So a busy machine loses them, whose socket is full; Aravis itself asks for no more than a quarter."""
    with (
        industrial_camera(FAULTY, faults=({"kind": "lost_packets", "nth": 1, "value": 0.5},)),
        opened(way, FAULTY) as camera,
    ):
        assert camera.capture(tmp_path).counter == 1


def test_a_camera_that_dies_and_one_that_comes_back(producer: Path, tmp_path: Path) -> None:
    """With harvesters; with Aravis, tests/machine_vision/test_genicam_driver.py does so."""
    with ExitStack() as until_the_end:
        with industrial_camera(FAULTY):
            way = {"producer": str(producer)}
            camera = until_the_end.enter_context(opened(way, FAULTY, frame_timeout_s=3.0))
            camera.capture(tmp_path)
        with pytest.raises((DeviceUnavailableError, DeviceTimeoutError)):
            camera.capture(tmp_path)
        with industrial_camera(FAULTY):
            camera.open()
            assert camera.capture(tmp_path).jpeg.size_bytes > 0
