"""A Canon EOS that was recorded is served by `simulate canon --replay`: what it stated is what the driver reads."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from drivers.errors import DeviceRefusedError
from drivers.interfaces import CameraSettings, answers_of
from drivers.recording import RecordedDevice, Recording, readable
from tests.support.rig.camera_simulator import camera_simulator
from tests.support.rig.doctor_recording import recorded
from tests.support.rig.gphoto_rig import driver, gphoto_rig
from tests.support.rig.rig import orthocapture, simulated_rig
from tests.support.rig.simulator_process import simulator

# Numbers of image formats as libgphoto2 has them: a byte for each file; fine and normal JPEG, RAW, and RAW with JPEG.
LARGE, MEDIUM, SMALL_2, C_RAW, RAW_AND_LARGE = 0x03FF, 0x13FF, 0xD3FF, 0x0BFF, 0x0C03
OTHER = CameraSettings(aperture_f=11.0, exposure_s=1 / 15, iso=200, focus_mode="Manual", image_quality="RAW+JPEG")


def numbers(code: str, kind: str, value: int, *choices: int, access: str = "rw") -> dict[str, Any]:
    kind_of_list = "enum" if choices or code == "d105" else "none"
    return {"code": code, "type": kind, "access": access, "form": kind_of_list, "numbers": choices, "value": value}


def text(code: str, value: str) -> dict[str, Any]:
    return {"code": code, "type": "str", "access": "ro", "form": "none", "value": value}


ANOTHER: tuple[dict[str, Any], ...] = (
    numbers("d101", "u16", 0x40, 0x38, 0x40, 0x45),  # f/11
    numbers("d102", "u16", 0x70, 0x58, 0x68, 0x70),  # 1/125 s
    numbers("d103", "u16", 0x50, 0x48, 0x50, 0x58),
    numbers("d105", "u16", 3),
    numbers("d106", "u16", 0, 0, 5),
    numbers("d108", "u32", 3, 0, 1, access="ro"),
    numbers("d109", "u8", 1, 0, 1),
    numbers("d111", "u16", 1, access="ro"),
    numbers("d114", "i32", -3),
    numbers("d11b", "u32", 77, access="ro"),
    numbers("d11c", "u32", 2, 2, 4),
    numbers("d11e", "u32", 0x00010001, access="ro"),
    numbers("d120", "u16", MEDIUM, LARGE, MEDIUM, SMALL_2, C_RAW, RAW_AND_LARGE),
    text("d1af", "(serial number 1)"),
    numbers("d1b0", "u32", 1, 0, 1, 2, 3),
    numbers("d1b1", "u16", 1, 0, 1),
    text("d1d8", "RF50mm F1.8 STM"),
)
UNSERVED: tuple[dict[str, Any], ...] = (text("d1a0", ""), numbers("5001", "u8", 90), text("d115", ""))


def written(file: Path, *properties: dict[str, Any], maker: str = "Canon.Inc") -> Path:
    listing = {"maker": maker, "model": "Canon EOS R8", "firmware": "3-1.4.0", "protocol": 100}
    device = {"kind": "camera", "driver": "gphoto", "answers": {"listing": {**listing, "properties": properties}}}
    recording = Recording(by="a test", devices={"camera": RecordedDevice.model_validate(device)})
    file.write_text(readable(recording), encoding="utf-8")
    return file


def test_a_canon_is_the_same_on_the_replay_of_what_the_doctor_recorded(tmp_path: Path) -> None:
    options = ("--fast", "--battery", "31", "--lens-switch", "AF", "--mode-dial", "Av", "--no-card")
    with camera_simulator([], *options, name="canon") as running:
        section: dict[str, object] = {"driver": "gphoto", "port": running.gphoto_port}
        first = recorded(tmp_path / "first.json", "body", section)
    with camera_simulator([], "--fast", "--replay", str(tmp_path / "first.json"), name="canon") as running:
        section = {"driver": "gphoto", "port": running.gphoto_port}
        again = recorded(tmp_path / "again.json", "body", section)
    assert first.report is not None
    assert again.report is not None
    assert again.answers == first.answers
    assert again.report.details == first.report.details
    assert again.report.problems == first.report.problems
    assert again.report.battery_fraction == first.report.battery_fraction


@pytest.mark.slow
def test_a_rig_serves_a_recorded_canon(tmp_path: Path) -> None:
    with camera_simulator([], "--fast", "--battery", "31", name="canon") as running:
        section: dict[str, object] = {"driver": "gphoto", "port": running.gphoto_port}
        recorded(tmp_path / "first.json", "body", section)
    (tmp_path / "rig").mkdir()
    options = ("--scene", "7", "--image-width", "480", "--replay", str(tmp_path / "first.json"))
    with simulated_rig(tmp_path / "rig", *options, host="127.0.0.11") as rig:
        answer = orthocapture("doctor", "--rig", rig["rig"], "--data", str(tmp_path / "data"), "--json")
        assert not [line for line in rig["not_served"] if "simulated as in any rig" in line]
    camera = json.loads(answer.stdout)["devices"]["camera"]
    assert camera["identity"]["model"] == "Canon EOS R5"
    assert camera["battery_fraction"] == 0.25


def test_what_another_body_stated_is_what_the_driver_reads(tmp_path: Path) -> None:
    """Codes, types, access, choices and values, through libgphoto2; it then obeys within what it states."""
    file = written(tmp_path / "r8.json", *ANOTHER)
    with gphoto_rig("canon", [], "--fast", "--replay", str(file)) as (camera, _):
        report, listing = camera.report(), answers_of(camera).listing
        assert listing is not None
        assert (listing.model, listing.firmware) == ("Canon EOS R8", "3-1.4.0")
        said = {p.code: p.model_dump(mode="json") for p in listing.properties}
        assert said.keys() == {p["code"] for p in ANOTHER}
        for stated in ANOTHER:
            again = said[stated["code"]]
            assert again | {"numbers": tuple(again["numbers"])} == {"numbers": (), **stated}
        assert report.details["imageformat"] == "M"
        assert report.details["iso"] == "200"
        assert report.battery_fraction == pytest.approx(0.5)
        assert camera.apply(OTHER) == OTHER
        with pytest.raises(DeviceRefusedError, match="22"):
            camera.apply(CameraSettings(22.0, 1 / 15, 200, "Manual", "RAW+JPEG"))
        assert camera.capture(tmp_path).model == "Canon EOS R8"


def test_what_of_a_canons_listing_is_not_served_is_named(tmp_path: Path) -> None:
    file = written(tmp_path / "r8.json", *ANOTHER, *UNSERVED)
    with camera_simulator([], "--replay", str(file), name="canon") as running:
        camera = driver(running.gphoto_port)
        camera.open()
        listing = answers_of(camera).listing
        camera.close()
    assert listing is not None
    assert {p.code for p in listing.properties} == {p["code"] for p in (*ANOTHER, UNSERVED[2])}
    with simulator("canon", "--port", "0", "--replay", str(file)) as started:
        assert started.ready["not_served"] == [
            "d1a0: of a structure that is not known",
            "5001 = 90: it is stated otherwise than in events",
            "texts that are empty or were taken out: d1a0, d115",
        ]


@pytest.mark.parametrize(
    ("properties", "maker", "why"),
    [
        (ANOTHER, "Sony Corporation", "holds a body of Sony Corporation: another simulator serves it"),
        ((UNSERVED[1],), "Canon.Inc", "holds no property of a Canon EOS"),
    ],
)
def test_what_is_no_canon_is_refused(
    tmp_path: Path, properties: tuple[dict[str, Any], ...], maker: str, why: str
) -> None:
    file = written(tmp_path / "other.json", *properties, maker=maker)
    with pytest.raises(AssertionError, match="no ready line") as refused, simulator("canon", "--replay", str(file)):
        pass
    assert why in str(refused.value)
