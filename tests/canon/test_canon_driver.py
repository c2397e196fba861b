"""The camera driver in its hosted child process, against the simulated Canon EOS; and bodies without a profile."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from drivers.errors import (
    DeviceRefusedError,
    DeviceUnavailableError,
)
from drivers.interfaces import Camera, CameraSettings
from simulators.faults import FaultPlan
from simulators.ptpip import codec
from simulators.ptpip.reply import NOT_SUPPORTED, Reply
from simulators.ptpip.server import PtpIpServer
from tests.support.rig.camera_simulator import camera_simulator
from tests.support.rig.gphoto_rig import PAPER, driver, gphoto_rig
from tests.support.vendor.camera_vendor_session import vendor_session

rig = partial(gphoto_rig, "canon")


@pytest.fixture(scope="module")
def camera() -> Iterator[Camera]:
    with rig() as (device, _):
        yield device


def test_identity_and_report(camera: Camera) -> None:
    report = camera.report()
    assert (report.identity.model, report.identity.serial) == ("Canon EOS R5", "12025000017")
    assert report.details["profile"] == "canon_eos"
    assert report.battery_fraction == pytest.approx(1.0)
    assert report.free_bytes is not None
    assert report.free_bytes > 1e9
    assert report.problems == ()


def test_a_connection_that_breaks_while_it_begins_is_unavailable_and_no_refused_setting(tmp_path: Path) -> None:
    """libgphoto2 takes the camera for open, and says "Bad parameters" when a setting is read."""
    plan = [{"device": "camera", "on": "set_event_mode", "kind": "drop"}]
    with camera_simulator(plan, name="canon") as simulator:
        camera = driver(simulator.gphoto_port)
        try:
            with pytest.raises(DeviceUnavailableError, match="does not tell its settings"):
                camera.open()
            camera.open()
            camera.apply(PAPER)
            assert camera.capture(tmp_path).counter == 1
        finally:
            camera.close()


def test_settings_are_applied_and_read_back(camera: Camera) -> None:
    other = CameraSettings(8.0, 3.2, 400, "Manual", "RAW+JPEG")
    assert camera.apply(other) == other
    assert camera.apply(PAPER) == PAPER
    assert camera.settings() == PAPER


def test_a_setting_that_the_camera_lacks_is_refused_with_its_neighbours(camera: Camera) -> None:
    with pytest.raises(DeviceRefusedError, match="22") as refused:
        camera.apply(CameraSettings(23.7, 1 / 15, 100))
    assert "aperture 23.7" in refused.value.what


def test_files_are_those_on_the_card_and_advance(tmp_path: Path) -> None:
    log = tmp_path / "truth.jsonl"
    with rig([], "--exposures-log", str(log)) as (camera, _):
        camera.apply(PAPER)
        first = camera.capture(tmp_path)
        camera.apply(CameraSettings(22.0, 1 / 15, 100, "Manual", "RAW+JPEG"))
        second = camera.capture(tmp_path)
        camera.apply(CameraSettings(22.0, 1 / 15, 100, "Manual", "RAW"))
        third = camera.capture(tmp_path)
    truth = [json.loads(line) for line in log.read_text().splitlines()]
    assert [one.counter for one in (first, second, third)] == [1, 2, 3]
    assert first.exif_time < second.exif_time < third.exif_time
    assert [one.files[0].sha256 for one in (first, second, third)] == [line["sha256"] for line in truth]
    assert [file.camera_name for file in second.files] == ["IMG_0002.JPG", "IMG_0002.CR3"]
    assert [file.media_type for file in second.files] == ["image/jpeg", "image/x-canon-cr3"]
    assert [file.camera_name for file in third.files] == ["IMG_0003.CR3"]
    assert (first.exif.aperture_f, first.exif.exposure_s, first.exif.iso) == (22.0, pytest.approx(1 / 15), 100)
    assert (first.lens, first.body_serial) == ("RF24-70mm F2.8 L IS USM", "012025000017")


@pytest.mark.slow
def test_large_files_come_in_parts(tmp_path: Path) -> None:
    """Beyond a megabyte, libgphoto2 asks for parts."""
    log = tmp_path / "truth.jsonl"
    with camera_simulator((), "--exposures-log", str(log), name="canon", width=4000) as simulator:
        camera = driver(simulator.gphoto_port)
        camera.open()
        camera.apply(CameraSettings(22.0, 1 / 15, 100, "Manual", "RAW"))
        (raw,) = camera.capture(tmp_path).files
        camera.close()
    assert raw.size_bytes > 1 << 20
    assert hashlib.sha256(raw.path.read_bytes()).hexdigest() == json.loads(log.read_text())["sha256"]


def test_the_client_answers_with_what_was_sent() -> None:
    """Only the camera's own report, or a new connection, tells what it has: the reason for the next test."""
    with camera_simulator([{"on": "set", "kind": "ignore", "times": 500}], name="canon") as simulator:
        _, echoed = vendor_session(simulator.gphoto_port, ["set", "iso", "100"], ["value", "iso"])
        assert echoed == "100"
        assert vendor_session(simulator.gphoto_port, ["value", "iso"]) == ["400"]


def test_a_setting_refused_in_silence_once_is_noticed_and_sent_again() -> None:
    with rig([{"on": "set", "kind": "ignore", "nth": 2}]) as (camera, _):
        assert camera.apply(PAPER) == PAPER


def test_a_setting_refused_in_silence_is_an_error_and_not_what_was_sent() -> None:
    with rig([{"on": "set", "kind": "ignore", "nth": 2, "times": 500}]) as (camera, _):
        with pytest.raises(DeviceRefusedError, match="keeps shutterspeed at 1/60 instead of 1/15"):
            camera.apply(PAPER)
        kept = camera.settings()
    assert (kept.aperture_f, kept.exposure_s, kept.iso) == (22.0, pytest.approx(1 / 60), 400)


def test_a_setting_refused_for_a_moment_is_sent_again() -> None:
    with rig([{"on": "set", "kind": "reject", "nth": 2, "times": 2}]) as (camera, _):
        assert camera.apply(PAPER) == PAPER


def test_a_floating_white_balance_becomes_daylight() -> None:
    with camera_simulator((), name="canon") as simulator:
        vendor_session(simulator.gphoto_port, ["set", "whitebalance", "Auto"])
        camera = driver(simulator.gphoto_port)
        camera.open()
        camera.apply(PAPER)
        assert camera.report().details["whitebalance"] == "Daylight"
        camera.close()
        camera = driver(simulator.gphoto_port, white_balance="Tungsten")
        camera.open()
        camera.apply(PAPER)
        assert camera.report().details["whitebalance"] == "Tungsten"
        camera.close()


def test_what_only_a_person_can_set() -> None:
    with rig([], "--lens-switch", "AF", "--mode-dial", "Av", "--battery", "10") as (camera, _):
        problems = " ".join(camera.report().problems)
        assert "Exposure program is AV" in problems
        assert "Battery" in problems
        with pytest.raises(DeviceRefusedError, match="focusmode One Shot where Manual") as refused:
            camera.apply(PAPER)
    assert "lens" in refused.value.remedy


def test_no_card(tmp_path: Path) -> None:
    """libgphoto2 numbers files from the memory itself: two of one exposure would look like two exposures."""
    with rig([], "--no-card") as (camera, _), pytest.raises(DeviceRefusedError, match="not from its card"):
        camera.capture(tmp_path)


class UnknownBody:
    """A camera of another maker: it says who it is, and has a card."""

    def handle(self, request: codec.Request, data: bytes) -> Reply:
        del data
        match request.operation:
            case 0x1001:
                operations = (0x1001, 0x1002, 0x1003, 0x1004, 0x1007)
                name = ("Acme Optical", "Wonder 3", "1.0", "0001")
                info = codec.DeviceInfo(*name, operations, (), (), (), vendor_extension=0, vendor_description="")
                return Reply(data=info.encode())
            case 0x1002 | 0x1003:
                return Reply()
            case 0x1004 | 0x1007:
                return Reply(data=codec.array_u32(()))
            case _:
                return Reply(NOT_SUPPORTED)


def test_a_body_without_a_profile_is_told_which_there_are() -> None:
    with PtpIpServer("127.0.0.1", 0, "Wonder 3", UnknownBody(), FaultPlan()) as server:
        port = server.address[1]
        camera = driver(f"ptpip:127.0.0.1:{port}:{port}")
        with pytest.raises(DeviceRefusedError, match="no profile for the body Acme Optical Wonder 3") as refused:
            camera.open()
        camera.close()
    assert all(name in refused.value.remedy for name in ("sony_ilce", "canon_eos", "nikon_z"))


def test_what_rig_yaml_names_must_exist() -> None:
    with camera_simulator((), name="canon") as simulator:
        for config, what in (({"profile": "leica"}, "no profile leica"), ({"capture_target": "both"}, "canon_eos")):
            camera = driver(simulator.gphoto_port, **config)
            with pytest.raises(DeviceRefusedError, match=what):
                camera.open()
            camera.close()
        camera = driver(simulator.gphoto_port, profile="canon_eos")
        assert camera.open().model == "Canon EOS R5"
        camera.close()


def test_the_focus_is_driven_and_the_exposure_compensated() -> None:
    """The seven steps of focus are those of a listed EOS R5."""
    with camera_simulator(name="canon") as simulator:
        focus, compensation, _, _, driven = vendor_session(
            simulator.gphoto_port,
            ["choices", "manualfocusdrive"],
            ["choices", "exposurecompensation"],
            ["set", "exposurecompensation", "-1.3"],
            ["preview"],
            ["set", "manualfocusdrive", "Far 1"],
        )
        assert focus == ["Near 1", "Near 2", "Near 3", "None", "Far 1", "Far 2", "Far 3"]
        assert len(compensation) == 19
        assert (compensation[0], compensation[-1]) == ("3", "-3")
        assert isinstance(driven, float)
        assert vendor_session(simulator.gphoto_port, ["value", "exposurecompensation"]) == ["-1.3"]
