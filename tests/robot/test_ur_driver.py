"""The Universal Robots driver in its hosted process against the simulated controller, over the real wires."""

from __future__ import annotations

import contextlib
import json
import socket
import time
from collections.abc import Callable, Generator

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivers.errors import (
    DeviceError,
    DeviceRefusedError,
    DeviceUnavailableError,
    LeaveNeededError,
    SafetyStopError,
    UnreachablePoseError,
)
from drivers.host.hosted_device import hosted
from drivers.interfaces import Array, Payload, RobotArm, SafetyState, SettleCriteria
from drivers.ur import UrConfig
from drivers.ur.safety import safety_state
from service.core.geometry import inverse, rotation_angle_rad, transform
from tests.support.arms.arm_watch import watched_arm
from tests.support.arms.ur_simulator import address, simulated_ur
from tests.support.processes.waiting import until
from tests.support.vendor.ur_rtde_protocol import RtdeClient

SPEED_UP = "3"
SPEED, ACCELERATION = 1.05, 1.4
T_FLANGE_TCP = transform(Rotation.from_euler("z", 0.3), np.array([0.01, 0.0, 0.1]))
PAYLOAD = Payload(1.6, (0.0, 0.0, 0.08))


@contextlib.contextmanager
def opened(host: str, **config: float) -> Generator[RobotArm]:
    config = {"watchdog_s": 1.0, **config}  # the machine is shared; tests/robot/test_watchdog.py tests the default
    arm = hosted(RobotArm, "drivers.ur:DRIVER", UrConfig(host=host, **config), call_timeout_s=30, name="robot")
    try:
        arm.open()
        let_move(arm)
        yield arm
    finally:
        arm.close()


def let_move(arm: RobotArm) -> None:
    arm.let_move("Ada", time.monotonic())


@pytest.fixture(scope="module")
def robot() -> Generator[RobotArm]:
    host = address(50)
    with simulated_ur(host, "--speed-up", SPEED_UP), opened(host) as arm:
        arm.configure(PAYLOAD, T_FLANGE_TCP)
        yield arm


def faulty(number: int, *faults: dict[str, object]) -> contextlib.AbstractContextManager[dict[str, str]]:
    plan = json.dumps([{"device": "robot", **fault} for fault in faults])
    return simulated_ur(address(number), "--speed-up", SPEED_UP, "--faults", plan)


def dashboard(host: str, *orders: str) -> list[str]:
    with socket.create_connection((host, 29999), timeout=30) as connection, connection.makefile("rw") as lines:
        lines.readline()
        answers: list[str] = []
        for order in orders:
            lines.write(order + "\n")
            lines.flush()
            answers.append(lines.readline().strip())
        return answers


def wait_for(condition: Callable[[], bool], timeout_s: float = 10.0) -> None:
    until(condition, "waited in vain", timeout_s, every_s=0.02)


def move(arm: RobotArm, joints: Array) -> None:
    arm.move_joints(joints, speed_rad_s=SPEED, acceleration_rad_s2=ACCELERATION)


def travel(arm: RobotArm, joints: Array) -> None:
    move(arm, joints)
    wait_for(lambda: not arm.is_moving())


def turned(arm: RobotArm, by_rad: float) -> Array:
    joints = arm.state().sample.joints_rad.copy()
    joints[0] += by_rad
    return joints


# --- the good day -------------------------------------------------------------------------------------------


def test_identity_and_report(robot: RobotArm) -> None:
    report = robot.report()
    assert report.identity.kind == "robot"
    assert report.identity.model == "UR10e"
    assert report.identity.serial.isdigit()
    assert report.identity.firmware.startswith("5.12")
    assert "ur_rtde 1." in report.identity.driver_version
    assert report.problems == ()
    sample = robot.state().sample
    assert report.clock_offset_s == pytest.approx(sample.controller_time_s - sample.monotonic_s, abs=0.05)


def test_flange_pose_has_no_tool_in_it(robot: RobotArm) -> None:
    before = robot.state().sample.T_base_flange
    robot.configure(PAYLOAD, np.eye(4))
    bare = robot.state().sample.T_base_flange
    robot.configure(PAYLOAD, T_FLANGE_TCP)
    np.testing.assert_allclose(bare, before, atol=1e-7)
    np.testing.assert_allclose(robot.state().sample.T_base_flange, before, atol=1e-7)


def test_move_to_a_pose_settle_and_read_the_exposure(robot: RobotArm) -> None:
    start = robot.state().sample
    goal = start.T_base_flange @ transform(Rotation.from_euler("xyz", [0.1, -0.1, 0.2]), np.array([0.05, 0.02, 0.04]))
    joints = robot.solve_ik(goal, start.joints_rad)
    assert np.max(np.abs(joints - start.joints_rad)) < 1.0, "the solution nearest to the present posture"
    move(robot, joints)
    assert robot.is_moving()
    assert not robot.settle(SettleCriteria()).settled
    wait_for(lambda: not robot.is_moving())
    assert not robot.settle(SettleCriteria()).settled, "the window still holds the motion"
    wait_for(lambda: robot.settle(SettleCriteria()).settled)
    report = robot.settle(SettleCriteria())
    difference = inverse(goal) @ report.T_base_flange
    assert np.linalg.norm(difference[:3, 3]) < 1e-6
    assert rotation_angle_rad(difference) < 1e-6
    begin = time.monotonic()
    time.sleep(0.3)
    samples = robot.samples(begin, time.monotonic())
    assert 15 <= len(samples) <= 45, "125 Hz"
    assert np.all(np.diff([s.controller_time_s for s in samples]) > 0)
    assert all(begin <= s.monotonic_s for s in samples)
    assert {s.safety for s in samples} == {SafetyState.NORMAL}


def test_stop_in_mid_motion(robot: RobotArm) -> None:
    start = robot.state().sample.joints_rad[0]
    move(robot, turned(robot, 1.5))
    time.sleep(0.3)
    robot.stop()
    wait_for(lambda: not robot.is_moving(), 2)
    wait_for(lambda: robot.settle(SettleCriteria(window_s=0.2)).settled, 3)
    done = robot.state().sample.joints_rad[0] - start
    assert 0.05 < done < 1.4
    time.sleep(0.2)
    assert robot.state().sample.joints_rad[0] - start == pytest.approx(done, abs=1e-4)
    move(robot, turned(robot, -done))
    wait_for(lambda: not robot.is_moving())


def test_unreachable_pose_is_refused_and_leaves_the_arm_fit(robot: RobotArm) -> None:
    sample = robot.state().sample
    far = sample.T_base_flange.copy()
    far[0, 3] += 3.0
    with pytest.raises(UnreachablePoseError, match="cannot reach the flange pose"):
        robot.solve_ik(far, sample.joints_rad)
    np.testing.assert_allclose(robot.solve_ik(sample.T_base_flange, sample.joints_rad), sample.joints_rad, atol=1e-6)


def test_wrong_requests_are_refused(robot: RobotArm) -> None:
    with pytest.raises(DeviceRefusedError, match="six finite numbers"):
        move(robot, np.zeros(5))


def test_refused_payload_leaves_a_usable_arm(robot: RobotArm) -> None:
    with pytest.raises(DeviceError):
        robot.configure(Payload(80.0, (0.0, 0.0, 0.0)), T_FLANGE_TCP)
    robot.configure(PAYLOAD, T_FLANGE_TCP)


# --- bad days -----------------------------------------------------------------------------------------------


def test_protective_stop_is_surfaced_and_cleared_by_a_person_only() -> None:
    host = address(51)
    with faulty(51, {"on": "move", "nth": 2, "kind": "protective_stop", "value": 0.1}), opened(host) as arm:
        move(arm, turned(arm, 0.1))
        wait_for(lambda: not arm.is_moving())
        move(arm, turned(arm, 1.0))
        with pytest.raises(SafetyStopError, match="protective stop"):
            wait_for(lambda: not arm.is_moving())
        assert arm.state().sample.safety is SafetyState.PROTECTIVE_STOP
        with pytest.raises(SafetyStopError):
            move(arm, turned(arm, 0.1))
        assert any("protective stop" in p for p in arm.report().problems)

        arm.open()  # reconnecting does not help
        assert arm.state().sample.safety is SafetyState.PROTECTIVE_STOP
        with pytest.raises(SafetyStopError):
            arm.configure(PAYLOAD, T_FLANGE_TCP)

        def unlocked() -> bool:
            return dashboard(host, "close safety popup", "unlock protective stop")[1].startswith(
                "Protective stop rel"
            )

        with pytest.raises(SafetyStopError):
            let_move(arm)
        wait_for(unlocked)
        wait_for(lambda: arm.state().sample.safety is SafetyState.NORMAL)
        with pytest.raises(SafetyStopError, match="nobody has confirmed since"):
            move(arm, turned(arm, 0.1))
        let_move(arm)
        travel(arm, turned(arm, 0.1))


def test_a_stop_that_came_and_was_released_between_two_motions_is_not_forgotten() -> None:
    host = address(62)
    # The plan causes the stop at a message that only this test sends: nobody queries the arm meanwhile.
    with faulty(62, {"on": "rtde_P", "kind": "protective_stop"}), opened(host) as arm, watched_arm(host) as watch:
        travel(arm, turned(arm, 0.1))
        client = RtdeClient(host)
        client.pause()
        client.close()
        begin = time.monotonic()

        def unlocked() -> bool:
            return dashboard(host, "unlock protective stop")[0].startswith("Protective stop rel")

        wait_for(unlocked)
        over = time.monotonic()
        assert over - begin > 1.0, "a person took a while"
        time.sleep(0.1)
        assert arm.state().sample.safety is SafetyState.NORMAL
        assert not arm.is_moving(), "nothing was cut short"
        since = watch.mark()
        for _ in range(3):
            with pytest.raises(SafetyStopError, match=r"was in protective stop .* nobody has confirmed since"):
                move(arm, turned(arm, 0.1))
        assert any("nobody has confirmed since" in problem for problem in arm.report().problems)
        with pytest.raises(SafetyStopError, match="nobody has confirmed since"):
            arm.let_move("Ada", begin)  # she confirmed before the stop was over
        time.sleep(0.5)
        assert watch.moved_for_s(since) == 0.0
        assert not watch.now.program_runs, "nothing is sent anew either"
        arm.let_move("Ada", over + 0.05)
        travel(arm, turned(arm, 0.1))
        assert watch.moved_for_s(since) > 0.0


def test_a_motion_ended_at_the_controller_did_not_arrive_and_waits_for_a_person() -> None:
    host = address(63)
    with simulated_ur(host), opened(host) as arm, watched_arm(host) as watch:
        move(arm, turned(arm, 2.0))
        watch.wait_moving(0.5)
        dashboard(host, "stop")
        with pytest.raises(LeaveNeededError, match="ended at the controller"):
            wait_for(lambda: not arm.is_moving())
        since = watch.mark()
        with pytest.raises(LeaveNeededError, match="ended at the controller"):
            move(arm, turned(arm, 0.1))
        assert watch.moved_for_s(since) == 0.0
        let_move(arm)
        travel(arm, turned(arm, 0.1))


def test_what_was_connected_anew_is_let_move_anew() -> None:
    with simulated_ur(address(64), "--speed-up", SPEED_UP), opened(address(64)) as arm:
        travel(arm, turned(arm, 0.1))
        arm.open()
        arm.configure(PAYLOAD, T_FLANGE_TCP)
        sample = arm.state().sample
        arm.solve_ik(sample.T_base_flange, sample.joints_rad)
        with pytest.raises(LeaveNeededError, match="nobody has let the arm move since it was connected"):
            move(arm, turned(arm, 0.1))
        let_move(arm)
        travel(arm, turned(arm, 0.1))


def test_emergency_stop() -> None:
    host = address(52)
    with faulty(52, {"on": "move", "kind": "emergency_stop", "value": 0.5}), opened(host) as arm:
        move(arm, turned(arm, 2.5))
        with pytest.raises(SafetyStopError, match="emergency stop"):
            wait_for(lambda: not arm.is_moving())
        time.sleep(0.4)  # the button is released
        dashboard(host, "power on")
        wait_for(lambda: arm.state().robot_mode == "IDLE")
        wait_for(lambda: arm.state().sample.safety is SafetyState.NORMAL)
        with pytest.raises(DeviceRefusedError, match="mode IDLE"):
            move(arm, turned(arm, 0.1))
        dashboard(host, "brake release")
        wait_for(lambda: arm.state().robot_mode == "RUNNING")
        with pytest.raises(SafetyStopError, match=r"emergency stop .* nobody has confirmed since"):
            move(arm, turned(arm, 0.1))
        let_move(arm)
        travel(arm, turned(arm, 0.1))


def test_refused_motion_is_an_error_and_the_next_one_works() -> None:
    with faulty(53, {"on": "move", "kind": "reject"}), opened(address(53)) as arm:
        with pytest.raises(DeviceRefusedError, match="did not start the joint motion"):
            move(arm, turned(arm, 0.1))
        move(arm, turned(arm, 0.1))
        wait_for(lambda: not arm.is_moving())


def test_reconnect_after_the_controller_restarted() -> None:
    host = address(54)
    with contextlib.ExitStack() as stack:
        with simulated_ur(host, "--speed-up", SPEED_UP):
            arm = stack.enter_context(opened(host, connect_timeout_s=1.0))
            arm.state()
        with pytest.raises(DeviceUnavailableError):
            wait_for(lambda: not arm.state(), 5)
        with pytest.raises(DeviceUnavailableError):
            arm.open()
        with simulated_ur(host, "--speed-up", SPEED_UP):
            arm.open()
            let_move(arm)
            travel(arm, turned(arm, 0.1))
            arm.close()


def test_dropped_link_ends_in_an_error_and_a_reconnect() -> None:
    host = address(60)
    with faulty(60, {"on": "move", "kind": "drop"}), opened(host, stale_after_s=0.5) as arm:
        with pytest.raises(DeviceUnavailableError):
            travel(arm, turned(arm, 0.5))
        arm.open()
        let_move(arm)
        travel(arm, turned(arm, 0.1))


def test_motion_that_ended_on_a_dead_stream_is_not_taken_for_an_arm_at_rest() -> None:
    drop: dict[str, object] = {"on": "move", "kind": "drop", "value": "receivers"}  # no samples; commands still pass
    with faulty(61, drop), opened(address(61), stale_after_s=3.0) as arm:
        with pytest.raises(DeviceUnavailableError, match="no new sample"):
            travel(arm, turned(arm, 0.1))
        arm.open()
        let_move(arm)
        travel(arm, turned(arm, 0.1))


def test_stalled_stream_is_not_taken_for_a_still_arm() -> None:
    with faulty(55, {"on": "move", "kind": "stall"}), opened(address(55), stale_after_s=0.5) as arm:
        with pytest.raises(DeviceUnavailableError, match="no new sample"):
            travel(arm, turned(arm, 0.5))
        with pytest.raises(DeviceUnavailableError):
            arm.settle(SettleCriteria())


@pytest.mark.parametrize(("on", "server"), [("rtde_V", "RTDE"), ("dashboard_connect", "dashboard")])
def test_mute_server_does_not_hang_the_driver(on: str, server: str) -> None:
    with (
        faulty(56, {"on": on, "kind": "stall"}),
        pytest.raises(DeviceUnavailableError, match=rf"the {server} server did not answer within 0\.5 s"),
        opened(address(56), connect_timeout_s=0.5),
    ):
        pass


def test_nobody_there() -> None:
    with pytest.raises(DeviceUnavailableError, match="RTDE server cannot be reached"), opened(address(57)):
        pass


@pytest.mark.parametrize("version", ["3.15", "5.25"])
def test_other_versions(version: str) -> None:
    model = "UR10" if version == "3.15" else "UR5e"
    host = address(58)
    with simulated_ur(host, "--version", version, "--model", model, "--speed-up", SPEED_UP), opened(host) as arm:
        assert arm.report().identity.model == model
        arm.configure(PAYLOAD, T_FLANGE_TCP)
        move(arm, turned(arm, 0.1))
        wait_for(lambda: not arm.is_moving())


def test_old_controllers_are_refused() -> None:
    host = address(59)
    with (
        simulated_ur(host, "--version", "5.4"),
        pytest.raises(DeviceError, match=r"Polyscope 5\.4 cannot say whether a pose is reachable"),
        opened(host),
    ):
        pass


@pytest.mark.parametrize(
    ("bits", "state"),
    [
        (0b1, SafetyState.NORMAL),
        (0b10, SafetyState.REDUCED),
        (0b10000000100, SafetyState.PROTECTIVE_STOP),
        (0b10000, SafetyState.SAFEGUARD_STOP),
        (0b11000000, SafetyState.EMERGENCY_STOP),
        (0b1000000000, SafetyState.FAULT),
        (0, SafetyState.UNKNOWN),
    ],
)
def test_safety_bits(bits: int, state: SafetyState) -> None:
    assert safety_state(bits) is state
    assert state.may_move == (state in (SafetyState.NORMAL, SafetyState.REDUCED))
