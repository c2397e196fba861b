"""`orthocapture protocol check` knows each kind's measures, their units, and plausible limits."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.cli.main import app
from service.store.store import Store

PROTOCOLS = Path(__file__).parents[2] / "protocols"


def _check(file: Path, *more: str) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["protocol", "check", str(file), *more], catch_exceptions=False)
    return done.exit_code, done.output


@pytest.mark.parametrize("file", sorted(PROTOCOLS.glob("*.yaml")), ids=lambda file: file.stem)
def test_our_protocols_are_credible(file: Path) -> None:
    status, words = _check(file)
    assert status == 0, words


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("measure: rms_px,", "measure: rms_pix,", "calibration measures no 'rms_pix'; did you mean 'rms_px'?"),
        ("max: 0.5, unit: px", "max: 0.5, unit: mm", "rms_px is in px, not in mm"),
        ("radius_mm: 15", "radius_mm: 0.015", "0.015 mm is not credible: 1 to 100 mm"),
        ("square_mm: 15", "square_mm: 0.015", "0.015 mm is not credible: 0.5 to 1000 mm"),
        ("measure: coverage, min: 0.9", "measure: coverage, min: 90", "a limit of 90 on coverage is not credible"),
        ("motion: {speed", "motion: {confirmed_for_s: 3600, speed", "3600 s is not credible: 10 to 300 s"),
        ("measure: robot_corrected_rms_px", "measure: robo_rms_px", "registration measures no 'robo_rms_px'"),
    ],
)
def test_what_cannot_be_meant_is_said_by_line(tmp_path: Path, old: str, new: str, words: str) -> None:
    text = (PROTOCOLS / "exvivo_spine.yaml").read_text()
    assert old in text
    file = tmp_path / "protocol.yaml"
    file.write_text(text.replace(old, new, 1))
    status, said = _check(file)
    assert status == 1
    assert words in said
    assert f"{file}:{text[: text.index(old)].count(chr(10)) + 1}" in said


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "      calibration: intrinsics\n",
            "      calibration: intrinsic\n",
            "no step 'intrinsic'; did you mean 'intrinsics'?",
        ),
        (
            "spheres_of: ct_import",
            "spheres_of: ct_imprt",
            "there is no step 'ct_imprt'; did you mean 'ct_import'?",
        ),
        (
            "compare_with: ct_import, wait_s: 1800",
            "compare_with: scanning, wait_s: 1800",
            "step 'scanning' comes later",
        ),
        (
            "      registration: registration\n",
            "      registration: scanning\n",
            "'scanning' is a step of kind scan_import, but only one that registers can be named",
        ),
        (
            "application: spraying",
            "application: ct_import",
            "ct_import, but only one that applies a coat can be named",
        ),
        (
            "control_images_of: [control_capture_1, control_capture_2]",
            "control_images_of: [control_capture_1, spraying]",
            "'spraying' is a step of kind timed_application, but only one that takes photographs can be named",
        ),
    ],
)
def test_a_step_that_is_named_exists_comes_earlier_and_has_what_is_asked_of_it(
    tmp_path: Path, old: str, new: str, words: str
) -> None:
    text = (PROTOCOLS / "exvivo_spine.yaml").read_text()
    assert old in text
    file = tmp_path / "protocol.yaml"
    file.write_text(text.replace(old, new, 1))
    status, said = _check(file)
    assert status == 1
    assert words in said
    assert f"{file}:" in said


def test_poses_of_an_arm_need_its_mount(tmp_path: Path) -> None:
    text = (PROTOCOLS / "exvivo_spine.yaml").read_text()
    mount = "      hand_eye: hand_eye\n      scan"
    assert mount in text
    file = tmp_path / "protocol.yaml"
    file.write_text(text.replace(mount, "      scan"))
    status, said = _check(file)
    assert status == 1
    assert "viewpoint_capture_1 are an arm's, and robot and robot_corrected and triangulated poses need" in said
    at = text.index("params:\n      images_of: [viewpoint_capture_1, viewpoint_capture_2]")
    assert f"{file}:{text[:at].count(chr(10)) + 1}" in said


def test_a_station_that_the_rig_has_not_is_said(tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    station = "{robot: robot, scene_centre_m: [0, 0, 0], approach_azimuth_deg: 0}"
    rig.write_text(
        f"name: r\ndevices:\n  robot: {{driver: ur, host: 192.0.2.1}}\nstations: {{station_1: {station}}}\n"
    )
    file = PROTOCOLS / "exvivo_spine.yaml"
    assert _check(file)[0] == 0
    status, said = _check(file, "--rig", str(rig))
    assert status == 1
    assert "the rig has no station 'station_2'; did you mean 'station_1'?" in said


def test_a_run_does_not_start_with_what_the_check_refuses(tmp_path: Path) -> None:
    file = tmp_path / "protocol.yaml"
    text = (PROTOCOLS / "exvivo_spine.yaml").read_text()
    file.write_text(text.replace("measure: rms_px,", "measure: rms_pix,", 1))
    (tmp_path / "rig.yaml").write_text("name: r\nsimulated: true\ndevices: {}\n")
    arguments = ["run", str(file), "--rig", str(tmp_path / "rig.yaml"), "--data", str(tmp_path / "data")]
    done = CliRunner().invoke(app, [*arguments, "--operator", "Ada"])
    assert done.exit_code == 1
    assert "calibration measures no 'rms_pix'; did you mean 'rms_px'?" in done.output
    with Store.open(tmp_path / "data") as store:
        assert not store.runs()


def test_a_run_does_not_start_on_a_rig_without_a_device_that_a_step_needs(tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    station = "{robot: robot, scene_centre_m: [0, 0, 0], approach_azimuth_deg: 0}"
    rig.write_text(
        "name: r\nsimulated: true\n"
        'devices: {robot: {driver: ur, host: 127.0.0.1}, camera: {driver: gphoto, port: "ptpip:127.0.0.1"}}\n'
        f"stations: {{station_1: {station}, station_2: {station}}}\n"
    )
    arguments = ["run", str(PROTOCOLS / "exvivo_spine.yaml"), "--rig", str(rig), "--data", str(tmp_path / "data")]
    done = CliRunner().invoke(app, [*arguments, "--operator", "Ada"])
    assert done.exit_code == 1
    assert "step control_scan needs exactly one scanner, the rig has 0" in done.output


def test_a_wait_that_outlasts_the_confirmation_is_found(tmp_path: Path) -> None:
    text = (PROTOCOLS / "exvivo_spine.yaml").read_text()
    old = "recovery: {retries: 2}"
    assert old in text
    file = tmp_path / "protocol.yaml"
    file.write_text(text.replace(old, "recovery: {retries: 2, wait_s: 120}"))
    status, said = _check(file)
    assert status == 1
    assert "after 120 s the robot does not try again by itself: a confirmation holds for 60 s" in said
