"""What holds for every body that the gphoto driver knows, on each of the simulated ones."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from drivers.errors import (
    DeviceBusyError,
    DeviceStorageFullError,
    DeviceTimeoutError,
    DeviceUnavailableError,
    StaleImageError,
    UnreadableFileError,
)
from tests.support.rig.gphoto_rig import gphoto_rig as rig

pytestmark = pytest.mark.parametrize("body", ["camera", "canon"])


def test_live_view_waits_for_a_busy_camera(body: str) -> None:
    with rig(body, [{"on": "preview", "kind": "busy", "times": 2}]) as (camera, _):
        frame = camera.preview()
    assert (frame[:2], frame[-2:]) == (b"\xff\xd8", b"\xff\xd9")


def test_stale_image_is_known_by_its_bytes_in_another_folder(tmp_path: Path, body: str) -> None:
    other = tmp_path / "other"
    other.mkdir()
    with rig(body, [{"on": "image", "kind": "stale", "nth": 2}]) as (camera, _):
        first = camera.capture(tmp_path)
        with pytest.raises(StaleImageError, match="byte for byte"):
            camera.capture(other)
    assert hashlib.sha256(first.jpeg.path.read_bytes()).hexdigest() == first.jpeg.sha256


@pytest.mark.parametrize("on", ["image", "get_object"])
def test_truncated_jpeg_is_named_and_earlier_files_are_untouched(tmp_path: Path, body: str, on: str) -> None:
    with rig(body, [{"on": on, "kind": "truncate", "nth": 2}]) as (camera, _):
        first = camera.capture(tmp_path)
        with pytest.raises(UnreadableFileError, match=r"0002\.JPG.*not affected"):
            camera.capture(tmp_path)
        third = camera.capture(tmp_path)
    assert sorted(path.name[-8:] for path in tmp_path.glob("*.JPG")) == ["0001.JPG", "0003.JPG"]
    assert hashlib.sha256(first.jpeg.path.read_bytes()).hexdigest() == first.jpeg.sha256
    assert third.counter == 3


def test_busy_camera_is_asked_again(tmp_path: Path, body: str) -> None:
    with rig(body, [{"on": "shutter", "kind": "busy", "times": 2}]) as (camera, _):
        assert camera.capture(tmp_path).counter == 1


def test_camera_that_stays_busy(tmp_path: Path, body: str) -> None:
    with rig(body, [{"on": "shutter", "kind": "busy", "times": 50}]) as (camera, _), pytest.raises(DeviceBusyError):
        camera.capture(tmp_path)


def test_full_store(tmp_path: Path, body: str) -> None:
    """A Canon lists its storage; a Sony says how many photographs fit on its cards."""
    with rig(body, [{"on": "shutter", "kind": "disk_full"}], capture_target="card") as (camera, _):
        with pytest.raises(DeviceStorageFullError):
            camera.capture(tmp_path)
        assert any("change or insert the card" in problem for problem in camera.report().problems)


def test_shutter_without_an_image(tmp_path: Path, body: str) -> None:
    with rig(body, [{"on": "image", "kind": "no_image"}], capture_timeout_s=2.0) as (camera, _):
        with pytest.raises(DeviceTimeoutError, match="none"):
            camera.capture(tmp_path)
        assert camera.capture(tmp_path).counter == 2


@pytest.mark.parametrize("kind", ["drop", "reset"])
def test_link_lost_in_mid_download_then_open_again(tmp_path: Path, body: str, kind: str) -> None:
    with rig(body, [{"on": "get_object", "kind": kind, "nth": 2}]) as (camera, _):
        first = camera.capture(tmp_path)
        with pytest.raises(DeviceUnavailableError):
            camera.capture(tmp_path)
        camera.open()
        third = camera.capture(tmp_path)
    assert third.counter == 3
    assert hashlib.sha256(first.jpeg.path.read_bytes()).hexdigest() == first.jpeg.sha256
