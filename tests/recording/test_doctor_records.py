"""`orthocapture doctor --record FILE`: what every device of a rig said, also of those that do not open."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from drivers.recording import RecordedDevice, Recording, readable
from service.cli.main import app
from tests.support.arms.ur_simulator import address, simulated_ur
from tests.support.ct.ct_series import hospital, write_series
from tests.support.rig.camera_simulator import camera_simulator
from tests.support.rig.rig import orthocapture, simulated_rig

FOLDERS = """
name: Meier's rig
devices:
  scanner: {driver: scan_folder, folder: scans, stable_s: 0, profile: artec_leo}
  second scanner: {driver: scan_folder, folder: nowhere, stable_s: 0}
  ct: {driver: dicom_folder, folder: ct, stable_s: 0}
  camera: {driver: gphoto, port: "ptpip:127.0.0.1:9:9"}
  arm: {driver: ur, hots: Meier's arm}
"""


def recorded(folder: Path, rig: str) -> Recording:
    (folder / "rig.yaml").write_text(rig)
    words = ["--rig", str(folder / "rig.yaml"), "--data", str(folder / "data"), "--record", str(folder / "out.json")]
    result = CliRunner().invoke(app, ["doctor", *words, "--json"], catch_exceptions=False)
    assert json.loads(result.stdout)["devices"], result.output
    return Recording.model_validate_json((folder / "out.json").read_text(encoding="utf-8"))


@pytest.mark.slow
def test_folders_and_what_does_not_open_stand_in_the_file(tmp_path: Path) -> None:
    write_series(tmp_path / "ct", change=hospital)
    (tmp_path / "scans").mkdir()
    (tmp_path / "scans" / "Meier left.ply").write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\n")
    (tmp_path / "scans" / "Meier right.stl").write_bytes(b"Meier".ljust(80) + bytes(4))
    recording = recorded(tmp_path, FOLDERS)
    said = (tmp_path / "out.json").read_text(encoding="utf-8")
    assert not [word for word in ("Meier", "DOE", "4711", "127.0.0.1", str(tmp_path), tmp_path.name) if word in said]
    assert list(recording.devices) == ["scanner", "scanner 2", "ct", "camera", "device"]
    scanner, missing, ct, camera, wrong = recording.devices.values()
    assert missing.error == "there is no such folder. Mount the share, or correct the folder in rig.yaml"
    assert missing.report is None
    assert camera.error.startswith("Connecting failed")
    assert camera.answers.silent == ("the camera is not open. Open it first",)
    assert wrong.driver == "ur"
    assert "hots" in wrong.error
    assert {one.format for one in scanner.answers.headers} == {"PLY", "STL"}
    assert scanner.report is not None
    assert any("(file " in problem for problem in scanner.report.problems)
    assert "Modality: CT" in ct.answers.headers[0].lines
    assert recording.taken_out


def test_a_file_that_exists_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text("name: bare\ndevices: {}\n")
    (tmp_path / "out.json").write_text("kept")
    words = ["--rig", str(tmp_path / "rig.yaml"), "--record", str(tmp_path / "out.json")]
    result = CliRunner().invoke(app, ["doctor", *words, "--data", str(tmp_path)])
    assert result.exit_code != 0
    assert "Name a new file" in result.output
    assert (tmp_path / "out.json").read_text() == "kept"


@pytest.mark.parametrize(
    ("options", "error"),
    [(("--version", "5.9"), "Polyscope 5.9 cannot say whether a pose is reachable"), (("--version", "5.12"), "")],
)
def test_an_arm_that_does_not_open_says_what_it_can(tmp_path: Path, options: tuple[str, ...], error: str) -> None:
    with simulated_ur(address(63), *options) as ready:
        devices = f"devices:\n  left arm: {{driver: ur, host: {ready['host']}}}\n"
        robot = recorded(tmp_path, f"name: bare\n{devices}").devices["robot"]
        assert ready["host"] not in (tmp_path / "out.json").read_text()
    assert robot.error.startswith(error)
    answers = {one.question: one.answer for one in robot.answers.exchanges}
    assert answers["get robot model"] == "UR10"
    assert answers["get serial number"] == "(serial number 1)"
    assert robot.answers.samples[0].source == "primary interface, kinematics"
    assert ("RTDE: the stream is not open" in robot.answers.silent) == bool(error)


def test_a_camera_is_listed_and_no_picture_taken(tmp_path: Path) -> None:
    log = tmp_path / "exposures.jsonl"
    with camera_simulator([], "--fast", "--exposures-log", str(log)) as simulated:
        devices = f"devices:\n  body: {{driver: gphoto, port: '{simulated.gphoto_port}'}}\n"
        camera = recorded(tmp_path, f"name: bare\n{devices}").devices["camera"]
    assert camera.answers.listing is not None
    assert camera.answers.listing.model == "ILCE-7RM5"
    assert camera.report is not None
    assert camera.report.identity.serial == "(serial number 1)"
    assert not log.exists()


@pytest.mark.slow
@pytest.mark.sweep  # each device alone: test_round_trips.py, test_replayed_machines.py, test_replayed_canon.py
def test_a_whole_rig_is_the_same_on_its_replay(tmp_path: Path) -> None:
    said: list[dict[str, RecordedDevice]] = []
    for name, replay in (("first", ()), ("again", ("--replay", str(tmp_path / "first.json")))):
        (tmp_path / name).mkdir()
        with simulated_rig(tmp_path / name, "--scene", "7", "--image-width", "480", *replay, host="127.0.0.9") as rig:
            file = tmp_path / f"{name}.json"
            words = ("doctor", "--rig", rig["rig"], "--data", str(tmp_path / "data"), "--record", str(file))
            assert orthocapture(*words).returncode == 0
            said.append(Recording.model_validate_json(file.read_text(encoding="utf-8")).devices)
            served = rig["not_served"]
    assert "lightbox (lightbox): simulated as in any rig" in served
    first, again = ({name: timeless(device) for name, device in devices.items()} for devices in said)
    assert list(first) == ["robot", "camera", "scanner", "ct", "lightbox"]
    assert again == first


def timeless(device: RecordedDevice) -> str:
    """The text of a device without clocks, the free space of this disk and the serial line's noise."""
    lines = readable(Recording(by="", devices={device.kind: device})).splitlines()
    moving = ("clock_offset_s", "timestamp", "free_bytes", '"LIGHT?"', '"TEMP?"', '"PEDAL?"', '"light"')
    return "\n".join(line for line in lines if not any(word in line for word in moving))
