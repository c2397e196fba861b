"""The camera's own button: a person presses it in the simulated world, and the driver collects the image."""

from __future__ import annotations

import threading
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import DeviceBusyError, DeviceUnavailableError
from drivers.interfaces import Camera, CameraSettings
from simulators.hand.technician import Press
from simulators.rig.world_server import World, WorldServer
from simulators.scene.world import Scene
from tests.support.processes.waiting import until
from tests.support.rig.camera_simulator import camera_simulator
from tests.support.rig.gphoto_rig import PAPER, driver


@contextmanager
def _world() -> Generator[tuple[World, str]]:
    world = World(Scene.generate(7), 240, (), np.zeros(6), camera_held=True)
    server = WorldServer(world, world.act)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield world, server.address
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def _open_when_ready(camera: Camera) -> None:
    """Retry, because a camera that is still building its scene answers later than the client waits."""
    for _ in range(30):
        camera.open()
        try:
            camera.preview()
        except (DeviceUnavailableError, DeviceBusyError):
            continue
        return
    raise AssertionError("the simulated body does not get ready")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Gets a line for each exposure, once its image is made."""
    path = tmp_path_factory.mktemp("camera") / "exposures.jsonl"
    path.touch()
    return path


@pytest.fixture(scope="module", params=["camera", "canon"])
def held(request: pytest.FixtureRequest, log: Path) -> Iterator[tuple[World, Camera]]:
    options = ("--fast", "--exposures-log", str(log))
    with (
        _world() as (world, address),
        camera_simulator((), "--world", address, *options, width=240, name=request.param) as simulator,
    ):
        camera = driver(simulator.gphoto_port)
        try:
            _open_when_ready(camera)
            camera.apply(PAPER)
            yield world, camera
        finally:
            camera.close()


def test_nothing_comes_while_nobody_presses(held: tuple[World, Camera], tmp_path: Path) -> None:
    assert held[1].released_images(tmp_path, 0.1) == ()


def test_a_press_of_the_button_brings_an_image(held: tuple[World, Camera], tmp_path: Path) -> None:
    world, camera = held
    world.press_shutter(Press())
    (image,) = camera.released_images(tmp_path, 90.0)
    assert image.jpeg.path.read_bytes()[:2] == b"\xff\xd8"
    assert image.exif == PAPER
    again = tmp_path / "again"
    again.mkdir()
    released_by_software = camera.capture(again)
    assert released_by_software.counter == image.counter + 1


def asked(camera: Camera) -> bool:
    camera.report()
    return True


def test_an_image_announced_while_the_camera_is_asked_something_else_is_not_lost(
    held: tuple[World, Camera], log: Path, tmp_path: Path
) -> None:
    world, camera = held
    before = len(log.read_text().splitlines())
    world.press_shutter(Press())
    until(lambda: asked(camera) and len(log.read_text().splitlines()) > before, "no exposure")
    for _ in range(5):  # its announcement arrives in between
        camera.report()
    (image,) = camera.released_images(tmp_path, 90.0)
    assert image.exif == PAPER


def test_a_dial_turned_by_accident_shows_in_the_file(held: tuple[World, Camera], tmp_path: Path) -> None:
    world, camera = held
    world.press_shutter(Press(iso=200))
    (image,) = camera.released_images(tmp_path, 90.0)
    assert image.exif.iso == 200
    assert camera.apply(PAPER) == CameraSettings(22.0, 1 / 15, 100, "Manual", "JPEG")


def test_raw_and_jpeg_of_one_press_are_one_image(held: tuple[World, Camera], tmp_path: Path) -> None:
    world, camera = held
    camera.apply(CameraSettings(22.0, 1 / 15, 100, "Manual", "RAW+JPEG"))
    world.press_shutter(Press())
    (image,) = camera.released_images(tmp_path, 90.0)
    assert [file.media_type.rpartition("-")[2] for file in image.files] in (
        ["image/jpeg", "arw"],
        ["image/jpeg", "cr3"],
    )
