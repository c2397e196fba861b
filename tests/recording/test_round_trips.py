"""A recording is served by a simulator, and recorded there again: the same but for times and what was taken out."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import DeviceRefusedError
from drivers.host.hosted_device import hosted
from drivers.interfaces import CameraSettings, DeviceAnswers, DeviceReport, RobotArm, answers_of
from drivers.recording import RecordedDevice, Recording, readable
from drivers.recording.personal_data import without_personal_data
from drivers.ur import UrConfig
from service.core.geometry import to_rotation_vector
from tests.support.arms.ur_driver import opened, wait_for
from tests.support.arms.ur_simulator import address, pendant, simulated_ur
from tests.support.rig.gphoto_rig import PAPER, gphoto_rig
from tests.support.rig.patience import PATIENT_UR
from tests.support.rig.simulator_process import simulator


def written(file: Path, driver: str, report: DeviceReport | None, answers: DeviceAnswers) -> RecordedDevice:
    """Write a recording of one device, without personal data."""
    kind = "camera" if driver == "gphoto" else "robot"
    device = RecordedDevice(kind=kind, driver=driver, report=report, answers=answers)
    clean = without_personal_data(Recording(by="a test", devices={kind: device}))
    file.write_text(readable(clean), encoding="utf-8")
    return clean.devices[kind]


# --- cameras ---


def listed(file: Path, name: str, *options: str) -> tuple[RecordedDevice, CameraSettings | str]:
    with gphoto_rig(name, [], "--fast", *options) as (camera, _):
        device = written(file, "gphoto", camera.report(), answers_of(camera))
        try:
            return device, camera.settings()
        except DeviceRefusedError as error:
            return device, error.what


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("camera", ()),
        ("camera", ("--battery", "31")),
        ("camera", ("--recorded", "ilce-1m2-3.00")),  # states more than libgphoto2 prints
        ("camera", ("--recorded", "ilce-7rm2-1.0")),
        ("nikon", ("--recorded", "z6-v1.00")),
        ("canon", ()),
        ("canon", ("--battery", "31", "--lens-switch", "AF", "--mode-dial", "Av")),
    ],
)
def test_a_body_is_the_same_on_the_replay_of_its_recording(
    tmp_path: Path, name: str, options: tuple[str, ...]
) -> None:
    first, settings = listed(tmp_path / "first.json", name, *options)
    again = listed(tmp_path / "again.json", name, "--replay", str(tmp_path / "first.json"))
    assert again == (first, settings)
    assert (tmp_path / "again.json").read_text() == (tmp_path / "first.json").read_text()
    assert first.answers.listing is not None
    assert len(first.answers.listing.properties) > (16 if name == "canon" else 20)


def test_the_replay_of_a_body_takes_settings_and_a_photograph(tmp_path: Path) -> None:
    listed(tmp_path / "first.json", "camera")
    with gphoto_rig("camera", [], "--fast", "--replay", str(tmp_path / "first.json")) as (camera, _):
        assert camera.apply(PAPER) == PAPER
        assert camera.capture(tmp_path).model == "ILCE-7RM5"


# --- arms ---


@contextmanager
def looked_at(host: str) -> Generator[RobotArm]:
    arm = hosted(
        RobotArm,
        "drivers.ur:DRIVER",
        UrConfig.model_validate({"host": host, **PATIENT_UR}),
        call_timeout_s=60,
        name="robot",
    )
    try:
        arm.open()
        yield arm
    finally:
        arm.close()


def heard(file: Path, host: str) -> RecordedDevice:
    with looked_at(host) as arm:
        return without_times(written(file, "ur", arm.report(), answers_of(arm)))


def without_times(device: RecordedDevice) -> RecordedDevice:
    assert device.report is not None
    samples = [
        one.model_copy(update={"fields": {name: v for name, v in one.fields.items() if name != "timestamp"}})
        for one in device.answers.samples
    ]
    answers = device.answers.model_copy(update={"samples": tuple(samples)})
    report = replace(device.report, clock_offset_s=None)
    return device.model_copy(update={"answers": answers, "report": report})


@pytest.mark.parametrize(
    ("options", "orders"),
    [
        (("--version", "5.12"), ()),
        (("--version", "3.15", "--model", "UR5"), ()),
        (("--version", "5.25", "--model", "UR20", "--initial-joints=0.1,-1.2,1.3,-1.4,-1.5,0.6"), ()),
        (("--local",), ()),
        ((), ("safety protective_stop",)),
        ((), ("slider 50",)),
    ],
)
def test_an_arm_is_the_same_on_the_replay_of_its_recording(
    tmp_path: Path, options: tuple[str, ...], orders: tuple[str, ...]
) -> None:
    with simulated_ur(address(61), *options) as ready:
        pendant(ready["host"], *orders)
        first = heard(tmp_path / "first.json", ready["host"])
    with simulated_ur(address(62), "--replay", str(tmp_path / "first.json")) as ready:
        again = heard(tmp_path / "again.json", ready["host"])
    assert again == first
    assert len(first.answers.exchanges) == 12
    assert first.answers.silent == ()


def calibrated(device: RecordedDevice) -> RecordedDevice:
    """The same arm with a shorter last link and a turned wrist, as real arms have them."""
    primary, stream = device.answers.samples
    d_m, alpha_rad = list(primary.fields["d_m"]), list(primary.fields["alpha_rad"])
    d_m[5] -= 0.00094
    alpha_rad[3] += 0.0047
    fields = primary.fields | {"d_m": tuple(d_m), "alpha_rad": tuple(alpha_rad), "theta_rad": (0.0,) * 5 + (0.002,)}
    stated = {name: value for name, value in stream.fields.items() if name != "actual_TCP_pose"}
    samples = (primary.model_copy(update={"fields": fields}), stream.model_copy(update={"fields": stated}))
    return device.model_copy(update={"answers": device.answers.model_copy(update={"samples": samples})})


def test_the_calibration_of_an_arm_is_served_and_computed_with(tmp_path: Path) -> None:
    with simulated_ur(address(61)) as ready:
        arm = calibrated(heard(tmp_path / "first.json", ready["host"]))
    file = tmp_path / "calibrated.json"
    file.write_text(readable(Recording(by="a test", devices={"robot": arm})))
    with simulated_ur(address(62), "--speed-up", "5", "--replay", str(file)) as ready, opened(ready["host"]) as robot:
        assert "this arm's own" in robot.report().details["calibration"]
        again = answers_of(robot)
        assert again.samples[0] == arm.answers.samples[0]
        state = robot.state().sample
        away = state.T_base_flange.copy()
        away[:3, 3] += (0.02, -0.03, 0.01)
        joints = robot.solve_ik(away, state.joints_rad)
        robot.move_joints(joints, speed_rad_s=1.0, acceleration_rad_s2=1.4)
        wait_for(lambda: not robot.is_moving() and not robot.state().sample.joint_velocities_rad_s.any())
        reached = robot.state().sample.T_base_flange
    np.testing.assert_allclose(to_rotation_vector(reached), to_rotation_vector(away), atol=1e-6)


def test_a_dashboards_own_words_are_said_until_its_state_changes(tmp_path: Path) -> None:
    with simulated_ur(address(61)) as ready:
        arm = heard(tmp_path / "first.json", ready["host"])
    words = {"safetymode": "Safety mode: all well", "get robot model": "UR10"}
    exchanges = tuple(
        one.model_copy(update={"answer": words.get(one.question, one.answer)}) for one in arm.answers.exchanges
    )
    other = arm.model_copy(update={"answers": arm.answers.model_copy(update={"exchanges": exchanges})})
    file = tmp_path / "other.json"
    file.write_text(readable(Recording(by="a test", devices={"robot": other})))

    def said(robot: RobotArm) -> str:
        return next(one.answer for one in answers_of(robot).exchanges if one.question == "safetymode")

    with simulated_ur(address(62), "--replay", str(file)) as ready, looked_at(ready["host"]) as robot:
        assert said(robot) == "Safety mode: all well"
        pendant(ready["host"], "safety protective_stop")
        assert said(robot) == "Safetymode: PROTECTIVE_STOP"


def test_what_a_replayed_body_does_not_tell_is_named(tmp_path: Path) -> None:
    listed(tmp_path / "first.json", "camera", "--recorded", "ilce-1m2-3.00")
    words = ("camera", "--port", "0", "--replay", str(tmp_path / "first.json"))
    with simulator(*words) as running:
        texts, numbers = running.ready["not_served"]
    assert texts.startswith("texts that are empty or were taken out: d223")
    assert numbers.startswith("not recorded: 56 properties in full")


def test_what_no_simulator_serves_is_named(tmp_path: Path) -> None:
    with simulated_ur(address(61)) as ready:
        heard(tmp_path / "first.json", ready["host"])
        assert ready["not_served"] == []
    with simulated_ur(address(62), "--replay", str(tmp_path / "first.json")) as ready:
        assert "dashboard, get serial number: (serial number 1)" in ready["not_served"]
        assert "dashboard, programState: PLAYING <unnamed>" in ready["not_served"]
        assert "RTDE, timestamp" in ready["not_served"]


HEAD = '"form": "orthocapture device recording", "version"'


@pytest.mark.parametrize(
    ("text", "name", "why"),
    [
        ("{}", "ur", "no recording of devices of version 1"),
        ("[", "camera", "cannot be read"),
        (f"{{{HEAD}: 2}}", "nikon", "no recording of devices of version 1"),
        (
            f'{{{HEAD}: 1, "devices": {{"a": {{"kind": "camera", "driver": "video"}}}}}}',
            "camera",
            "no device of the driver gphoto; there is a (video)",
        ),
        (
            f'{{{HEAD}: 1, "devices": {{"robot": {{"kind": "robot", "driver": "ur"}}}}}}',
            "ur",
            "did not tell its version",
        ),
    ],
)
def test_what_cannot_be_served_is_refused_in_words(tmp_path: Path, text: str, name: str, why: str) -> None:
    file = tmp_path / "file.json"
    file.write_text(text)
    with pytest.raises(AssertionError, match="no ready line") as refused, simulator(name, "--replay", str(file)):
        pass
    assert why in str(refused.value)
