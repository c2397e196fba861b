"""The GRBL driver in its hosted process against the simulated turntable, over a pseudo-terminal."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import (
    DeviceFaultError,
    DeviceRefusedError,
    DeviceUnavailableError,
    LeaveNeededError,
    SafetyStopError,
    UnreachablePoseError,
)
from drivers.grbl.wire import JOG_CANCEL
from drivers.interfaces import Array, RobotArm, SafetyState, SettleCriteria
from service.core.geometry import Transform, rotation_angle_rad, transform
from tests.support.arms.grbl_simulator import CENTRE_M, LIFT, TURN, Tap, fault, mount, opened, table
from tests.support.processes.hosts import driver_pid
from tests.support.processes.waiting import until

ANSWER_S = 3.0  # where answers are lost, which is known only then


def wait_for(condition: Callable[[], bool]) -> None:
    until(condition, "waited in vain", every_s=0.02)


def let_move(arm: RobotArm) -> None:
    arm.let_move("Ada", time.monotonic())


def move(arm: RobotArm, *degrees: float, speed_deg_s: float = 50.0) -> None:
    arm.move_joints(np.radians(degrees), speed_rad_s=np.radians(speed_deg_s), acceleration_rad_s2=1.5)


def travel(arm: RobotArm, *degrees: float) -> None:
    move(arm, *degrees)
    wait_for(lambda: not arm.is_moving())


def degrees(arm: RobotArm) -> Array:
    return np.degrees(arm.state().sample.joints_rad)


def turned(by_deg: float) -> Transform:
    c, s = np.cos(np.radians(by_deg)), np.sin(np.radians(by_deg))
    return transform(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), np.zeros(3))


@pytest.mark.slow
def test_a_day_without_trouble(tmp_path: Path) -> None:
    with table(tmp_path) as port, Tap(port, tmp_path) as tap, opened(tap.port, TURN, LIFT) as arm:
        report = arm.report()
        assert (report.identity.model, report.identity.kind, report.problems) == ("GRBL XY", "robot", ())
        assert report.identity.firmware.startswith("1.1h")
        with pytest.raises(LeaveNeededError):
            move(arm, -90, 0)
        assert b"$H" not in tap.sent
        let_move(arm)
        np.testing.assert_allclose(arm.state().sample.joints_rad, [np.radians(-1), -0.001], atol=1e-9)
        # The table turned by -100° turns the camera by 100° about the specimen, and the lift stands 40 mm lower.
        wanted = turned(100) @ transform(np.eye(3), np.array([0, 0, -0.04])) @ mount()
        joints = arm.solve_ik(wanted, arm.state().sample.joints_rad)
        np.testing.assert_allclose(joints, [np.radians(-100), -0.04], atol=1e-6)
        arm.move_joints(joints, speed_rad_s=0.8, acceleration_rad_s2=1.5)
        assert arm.is_moving()
        assert not arm.settle(SettleCriteria()).settled
        wait_for(lambda: not arm.is_moving())
        wait_for(lambda: arm.settle(SettleCriteria()).settled)
        gap = np.linalg.inv(wanted) @ arm.settle(SettleCriteria()).T_base_flange
        assert np.linalg.norm(gap[:3, 3]) < 1e-4  # whole steps
        assert rotation_angle_rad(gap) < 1e-3
        with pytest.raises(DeviceRefusedError, match="beyond"):
            move(arm, 20, 0)
        assert b"$X" not in tap.sent


@pytest.mark.slow
def test_a_pose_off_the_circle_cannot_be_reached(tmp_path: Path) -> None:
    with table(tmp_path) as port, opened(port) as arm:
        higher = transform(np.eye(3), np.array([0, 0, 0.2])) @ mount()
        with pytest.raises(UnreachablePoseError, match="200 mm"):
            arm.solve_ik(higher, np.array([-1.0]))
        near = arm.solve_ik(turned(30) @ mount(), np.radians([-400.0]))
        np.testing.assert_allclose(np.degrees(near), [-390.0], atol=1e-3)  # not a needless revolution


@pytest.mark.slow
def test_a_stop_brakes_and_the_axes_go_on_from_there(tmp_path: Path) -> None:
    with table(tmp_path) as port, opened(port) as arm:
        let_move(arm)
        move(arm, -600)
        wait_for(lambda: degrees(arm)[0] < -40)
        arm.stop()
        assert not arm.is_moving()
        stood = degrees(arm)[0]
        assert -590 < stood < -40
        begin = time.monotonic()
        wait_for(lambda: arm.settle(SettleCriteria()).settled)
        assert degrees(arm)[0] == stood
        speeds = [abs(s.joint_velocities_rad_s[0]) for s in arm.samples(begin, time.monotonic())]
        assert max(speeds) == 0.0
        travel(arm, stood + 5)
        np.testing.assert_allclose(degrees(arm), [stood + 5], atol=0.02)


def test_an_alarm_latches_and_only_a_persons_confirmation_leads_to_homing(tmp_path: Path) -> None:
    plan = fault(on="jog", kind="hard_limit", nth=12)
    with table(tmp_path, *plan) as port, Tap(port, tmp_path) as tap, opened(tap.port) as arm:
        let_move(arm)
        before_s = time.monotonic()
        with pytest.raises(SafetyStopError, match="limit switch"):
            travel(arm, -500)
        homings = tap.sent.count(b"$H")
        with pytest.raises(SafetyStopError):
            move(arm, -10)
        with pytest.raises(SafetyStopError):
            arm.let_move("Ada", before_s)  # said before it happened
        assert tap.sent.count(b"$H") == homings == 1
        assert any("alarm" in problem for problem in arm.report().problems)
        let_move(arm)
        assert tap.sent.count(b"$H") == 2
        assert b"$X" not in tap.sent
        assert arm.state().sample.safety is SafetyState.NORMAL
        travel(arm, -20)
        np.testing.assert_allclose(degrees(arm), [-20], atol=0.02)


@pytest.mark.parametrize(
    ("kind", "value", "error", "words"),
    [
        ("reset_button", 0, SafetyStopError, "was in"),
        ("door", 0.3, SafetyStopError, "safeguard"),
        ("door", 1e-6, SafetyStopError, "safeguard"),  # closed again before the next report
        # What the driver sees first: the axes stand, or a piece of the motion that came too late is refused.
        ("hold_button", 0, LeaveNeededError, "stopped the axes|refused a part"),
    ],
)
def test_whatever_interrupts_a_motion_waits_for_a_person(
    tmp_path: Path, kind: str, value: float, error: type[Exception], words: str
) -> None:
    with table(tmp_path, *fault(on="jog", kind=kind, nth=8, value=value)) as port, opened(port) as arm:
        let_move(arm)
        with pytest.raises(error, match=words):
            travel(arm, -500)
        with pytest.raises(error):
            move(arm, -400)
        wait_for(lambda: arm.state().robot_mode != "Door" or _closed(arm))
        let_move(arm)
        travel(arm, -30)
        np.testing.assert_allclose(degrees(arm), [-30], atol=0.02)


def _closed(arm: RobotArm) -> bool:
    try:
        let_move(arm)
    except SafetyStopError:
        return False
    return True


def test_axes_that_nobody_looks_at_are_stopped(tmp_path: Path) -> None:
    with table(tmp_path) as port, Tap(port, tmp_path) as tap, opened(tap.port, unattended_s=0.3) as arm:
        let_move(arm)
        move(arm, -700, speed_deg_s=30)
        wait_for(lambda: JOG_CANCEL in tap.sent)
        with pytest.raises(LeaveNeededError, match="nobody had looked"):
            wait_for(lambda: not arm.is_moving())
        wait_for(lambda: arm.state().robot_mode == "Idle")
        assert degrees(arm)[0] > -600, "it stopped on its way"


@pytest.mark.slow
def test_without_its_host_the_machine_soon_stands(tmp_path: Path) -> None:
    """The driver's process is killed during a motion: the controller has only a moment of it in its buffer."""
    with table(tmp_path) as port, Tap(port, tmp_path) as tap, opened(tap.port) as arm:
        let_move(arm)
        move(arm, -700)
        wait_for(lambda: degrees(arm)[0] < -40)
        seen_s, at_the_end = time.monotonic(), degrees(arm)[0]
        kill(arm)
        took_s = time.monotonic() - seen_s
        handed_over = [float(x) for x in re.findall(rb"\$J=G53G90G21X(-[\d.]+)", tap.sent)]
        assert min(handed_over) > at_the_end - 50 * (1.0 + took_s)
        assert b"X-700.000" not in tap.sent


def kill(arm: RobotArm) -> None:
    os.kill(driver_pid(arm), signal.SIGKILL)
    with pytest.raises(DeviceUnavailableError):
        arm.state()


def test_homing_without_a_switch_fails_and_says_so(tmp_path: Path) -> None:
    with table(tmp_path, *fault(on="$H", kind="no_switch")) as port, opened(port) as arm:
        with pytest.raises(SafetyStopError, match="no limit switch"):
            let_move(arm)
        with pytest.raises(SafetyStopError):
            move(arm, -10)
        let_move(arm)
        travel(arm, -10)


def losing(answers: int, after: bytes) -> Callable[[bytes, bool], bytes]:
    """A line on which so many `ok` are lost, from when the host has sent these bytes."""
    seen, left = bytearray(), [answers]

    def spoil(data: bytes, sent: bool) -> bytes:
        if sent:
            seen.extend(data)
            return data
        if after not in seen or not left[0]:
            return data
        spoilt = data.replace(b"ok\r\n", b"", left[0])
        left[0] -= (len(data) - len(spoilt)) // 4
        return spoilt

    return spoil


def test_a_cable_that_is_pulled_while_it_homes_is_unavailable_and_not_a_question_of_leave(tmp_path: Path) -> None:
    """With a question alone a person could confirm for ever: only opening it again brings the line back."""
    with table(tmp_path, *fault(on="$H", kind="unplug", value=0.5)) as port, opened(port) as arm:
        with pytest.raises(DeviceUnavailableError, match="connection is lost"):
            let_move(arm)
        wait_for(port.exists)
        arm.open()
        with pytest.raises(LeaveNeededError):
            move(arm, -10)
        let_move(arm)
        travel(arm, -10)


@pytest.mark.slow
@pytest.mark.parametrize("lost", ["answer", "command"])
def test_homing_without_an_answer_is_noticed_long_before_its_longest_time(tmp_path: Path, lost: str) -> None:
    plan = fault(on="$H", kind="drop") if lost == "command" else ()
    tap = losing(1, b"$H\n") if lost == "answer" else losing(0, b"")
    with (
        table(tmp_path, *plan) as port,
        Tap(port, tmp_path, tap) as tapped,
        opened(tapped.port, homing_timeout_s=3600.0, answer_timeout_s=ANSWER_S) as arm,
    ):
        with pytest.raises(LeaveNeededError, match=r"homing failed.*reports that it does not home"):
            let_move(arm)
        with pytest.raises(LeaveNeededError):
            move(arm, -10)
        let_move(arm)
        travel(arm, -10)
        assert tapped.sent.count(b"$H") == 2, "only the controller's answer says that the position is known"


def test_a_command_to_home_that_arrives_as_the_one_to_unlock_does_not_count(tmp_path: Path) -> None:
    """The two differ by one bit, and the controller says ok to both."""
    spoilt: list[bytes] = []

    def spoil(data: bytes, sent: bool) -> bytes:
        if sent and b"$H\n" in data and not spoilt:
            spoilt.append(data)
            return data.replace(b"$H\n", b"$X\n")
        return data

    with table(tmp_path) as port, Tap(port, tmp_path, spoil) as tap, opened(tap.port) as arm:
        with pytest.raises(LeaveNeededError, match="unlocks"):
            let_move(arm)
        with pytest.raises(LeaveNeededError):
            move(arm, -10)
        let_move(arm)
        travel(arm, -10)
        assert tap.sent.count(b"$H") == 2


def losing_answers(tap: Tap) -> contextlib.AbstractContextManager[RobotArm]:
    return opened(tap.port, answer_timeout_s=ANSWER_S)


@pytest.mark.slow
def test_a_lost_answer_to_a_piece_of_a_motion_costs_a_moment(tmp_path: Path) -> None:
    with table(tmp_path) as port, Tap(port, tmp_path, losing(1, b"$J=")) as tap, losing_answers(tap) as arm:
        let_move(arm)
        travel(arm, -20)
        travel(arm, -40)
        np.testing.assert_allclose(degrees(arm), [-40], atol=0.02)


@pytest.mark.slow
def test_axes_that_ran_dry_do_not_move_on_by_themselves(tmp_path: Path) -> None:
    with table(tmp_path) as port, Tap(port, tmp_path, losing(3, b"$J=")) as tap, losing_answers(tap) as arm:
        let_move(arm)
        with pytest.raises(LeaveNeededError, match="did not answer to a part"):
            travel(arm, -300)
        stood = degrees(arm)
        arm.stop()
        np.testing.assert_allclose(degrees(arm), stood)
        let_move(arm)
        travel(arm, -60)
        np.testing.assert_allclose(degrees(arm), [-60], atol=0.02)


@pytest.mark.parametrize(("setting", "words"), [("22=0", r"\$22=1"), ("13=1", r"\$13=0")])
def test_settings_with_which_positions_would_be_wrong_are_refused(tmp_path: Path, setting: str, words: str) -> None:
    with table(tmp_path, "--setting", setting) as port, pytest.raises(DeviceFaultError, match=words), opened(port):
        pass


def test_work_coordinates_are_told_from_machine_coordinates(tmp_path: Path) -> None:
    with table(tmp_path, "--setting", "10=0") as port, opened(port, TURN, LIFT) as arm:
        let_move(arm)
        arm.move_joints(np.array([np.radians(-30), -0.02]), speed_rad_s=1.0, acceleration_rad_s2=1.5)
        wait_for(lambda: not arm.is_moving())
        np.testing.assert_allclose(arm.state().sample.joints_rad, [np.radians(-30), -0.02], atol=1e-4)


def test_settings_that_weaken_the_machine_are_problems(tmp_path: Path) -> None:
    with table(tmp_path, "--setting", "1=25", "20=0", "21=0", "130=360") as port, opened(port) as arm:
        problems = " ".join(arm.report().problems)
    assert re.search(r"Soft limits.*Hard limits.*\$1=255.*axis X", problems)


def test_an_acceleration_beyond_the_protocols_is_refused(tmp_path: Path) -> None:
    with table(tmp_path, "--setting", "120=200") as port, opened(port) as arm:
        let_move(arm)
        with pytest.raises(DeviceRefusedError, match="200°/s²"):
            move(arm, -20)


def test_a_pulled_cable_is_unavailable_and_opens_again(tmp_path: Path) -> None:
    with table(tmp_path, *fault(on="jog", kind="unplug", nth=6, value=0.5)) as port, opened(port) as arm:
        let_move(arm)
        with pytest.raises(DeviceUnavailableError):
            travel(arm, -500)
        wait_for(port.exists)
        arm.open()
        with pytest.raises(LeaveNeededError):
            move(arm, -10)
        let_move(arm)
        travel(arm, -10)


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=pytest.mark.sweep) for kind in ("drop", "corrupt", "truncate", "stall")]
)
def test_spoilt_reports_do_not_stop_a_motion(tmp_path: Path, kind: str) -> None:
    with table(tmp_path, *fault(on="?", kind=kind, nth=30, times=2, value=0.1)) as port, opened(port) as arm:
        let_move(arm)
        travel(arm, -90)
        np.testing.assert_allclose(degrees(arm), [-90], atol=0.02)


def test_a_refused_piece_ends_the_motion(tmp_path: Path) -> None:
    with table(tmp_path, *fault(on="jog", kind="reject", nth=5, value=15)) as port, opened(port) as arm:
        let_move(arm)
        with pytest.raises(LeaveNeededError, match="outside the travel"):
            travel(arm, -300)


def test_nothing_on_the_port_is_unavailable(tmp_path: Path) -> None:
    with pytest.raises(DeviceUnavailableError, match="cannot be opened"), opened(tmp_path / "nowhere"):
        pass


def test_the_centre_of_the_scene_stays_on_the_axis() -> None:
    np.testing.assert_allclose(turned(70)[:3, :3] @ CENTRE_M, CENTRE_M)
