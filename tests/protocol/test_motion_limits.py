"""How fast a protocol may move an arm: the arm's own limits, and how soon it stands if the program dies."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from drivers.interfaces import Abandoned
from service.cli.main import app
from service.core.arms import ArmModel, known_arms
from service.core.errors import OrthocaptureError
from service.core.protocol import Motion, load_protocol, motion_problems
from service.rig import load_rig
from service.run_start import require_runnable
from service.station import devices_of
from service.steps import params_models

EXVIVO = Path(__file__).parents[2] / "protocols" / "exvivo_spine.yaml"
RIG = """
name: lab
devices:
  robot: {driver: ur, host: 192.0.2.1, watchdog_s: WATCHDOG, rest_within_s: REST}
stations:
  station_1: {robot: robot, scene_centre_m: [0, 0.8, 0], approach_azimuth_deg: 0}
  station_2: {robot: robot, scene_centre_m: [0, 0.8, 0], approach_azimuth_deg: 0}
"""
USUAL = Abandoned(noticed_after_s=0.2, rest_within_s=0.45)


def fields(motion: Motion, arm: ArmModel, abandoned: Abandoned | None = None) -> list[str]:
    return [field for field, _words in motion_problems(motion, [arm], abandoned)]


@pytest.mark.parametrize("arm", known_arms(), ids=lambda arm: arm.name)
def test_every_arm_has_its_own_limits(arm: ArmModel) -> None:
    most_rad_s, most_rad_s2 = float(arm.speeds_rad_s.min()), arm.acceleration_rad_s2
    assert fields(Motion(speed_rad_s=most_rad_s, acceleration_rad_s2=most_rad_s2), arm) == []
    assert fields(Motion(speed_rad_s=1.001 * most_rad_s), arm) == ["speed_rad_s"]
    assert fields(Motion(acceleration_rad_s2=1.001 * most_rad_s2), arm) == ["acceleration_rad_s2"]


@pytest.mark.parametrize("arm", known_arms(), ids=lambda arm: arm.name)
def test_no_arm_may_move_faster_than_its_client_library_takes(arm: ArmModel) -> None:
    """180°/s of a data sheet is more than the 3.14 rad/s of ur_rtde, which refused it in mid-run."""
    if arm.family == "universal_robot":
        assert fields(Motion(speed_rad_s=3.141), arm) == ["speed_rad_s"]
        assert arm.speeds_rad_s.max() <= 3.14


@pytest.mark.parametrize("arm", known_arms(), ids=lambda arm: arm.name)
@pytest.mark.parametrize("watchdog_s", [0.1, 0.2, 0.4, 1.0])
def test_an_arm_whose_program_died_stands_in_time(arm: ArmModel, watchdog_s: float) -> None:
    """Decision 13: after 0.2 s and 0.25 s from 1 rad/s; a faster motion needs a shorter watchdog."""
    abandoned = Abandoned(watchdog_s, USUAL.rest_within_s)
    in_time_rad_s = (USUAL.rest_within_s - watchdog_s) * arm.braking_rad_s2
    for factor, sound in ((1.0, True), (1.01, False)):
        speed_rad_s = max(factor * in_time_rad_s, 0.01)
        too_fast = [speed_rad_s > arm.speeds_rad_s.min(), not (sound and in_time_rad_s > 0)]
        expected = ["speed_rad_s" for wrong in too_fast if wrong]
        assert fields(Motion(speed_rad_s=speed_rad_s), arm, abandoned) == expected


def check(file: Path, *more: str) -> tuple[int, str]:
    done = CliRunner().invoke(app, ["protocol", "check", str(file), *more], catch_exceptions=False)
    return done.exit_code, " ".join(done.output.split())


def moving(tmp_path: Path, motion: str) -> Path:
    text = EXVIVO.read_text()
    old = "motion: {speed_rad_s: 0.3, acceleration_rad_s2: 0.3, dwell_s: 0.5}"
    assert old in text
    file = tmp_path / "protocol.yaml"
    file.write_text(text.replace(old, f"motion: {{{motion}}}"))
    return file


@pytest.mark.parametrize(
    ("motion", "words"),
    [
        ("speed_rad_s: 1000", "the fastest arm that is known, turns by"),
        ("speed_rad_s: 3.2", "the fastest arm that is known, turns by"),
        ("acceleration_rad_s2: 400", "takes 40 rad/s² at most"),
    ],
)
def test_what_no_arm_can_is_refused_without_a_rig(tmp_path: Path, motion: str, words: str) -> None:
    status, said = check(moving(tmp_path, motion))
    assert status == 1
    assert words in said
    assert "motion." in said


@pytest.mark.parametrize(
    ("speed_rad_s", "watchdog_s", "rest_within_s", "arm", "words"),
    [
        (1.0, 0.2, 0.45, "", ""),
        (1.1, 0.2, 0.45, "", "stands after 0.48 s"),
        (1.1, 0.1, 0.45, "", ""),
        (1.0, 1.0, 0.45, "", "move with 0.00 rad/s at most"),
        (3.1, 0.2, 1.0, "", ""),
        (3.1, 0.2, 1.0, "collision: {arm: UR10e}", "joint 1 of a UR10e turns by 2.09 rad/s at most"),
    ],
)
def test_speed_braking_and_watchdog_are_judged_together(
    tmp_path: Path, speed_rad_s: float, watchdog_s: float, rest_within_s: float, arm: str, words: str
) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text(RIG.replace("WATCHDOG", str(watchdog_s)).replace("REST", str(rest_within_s)) + arm)
    file = moving(tmp_path, f"speed_rad_s: {speed_rad_s}")
    loaded, site = load_protocol(file, params_models()), load_rig(rig)
    try:
        require_runnable(loaded, site, devices_of(site))
    except OrthocaptureError as error:  # of a station, a device or the motion: the words are compared
        said = " ".join(str(error).split())
    else:
        said = ""
    assert (words in said) if words else ("motion" not in said)
