"""The Universal Robots driver in its hosted process against the simulated controller, over the real wires."""

from __future__ import annotations

import threading
import time
from collections.abc import Generator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivers.errors import (
    DeviceError,
    DeviceRefusedError,
    UnreachablePoseError,
)
from drivers.interfaces import Payload, RobotArm, SafetyState, SettleCriteria
from drivers.ur.safety import safety_state
from service.core.geometry import inverse, rotation_angle_rad, transform
from tests.support.arms.ur_driver import (
    PAYLOAD,
    SPEED_UP,
    T_FLANGE_TCP,
    move,
    opened,
    pass_s,
    turned,
    wait_for,
)
from tests.support.arms.ur_simulator import address, simulated_ur


@pytest.fixture(scope="module")
def robot() -> Generator[RobotArm]:
    host = address(50)
    with simulated_ur(host, "--speed-up", SPEED_UP), opened(host) as arm:
        arm.configure(PAYLOAD, T_FLANGE_TCP)
        yield arm


def test_identity_and_report(robot: RobotArm) -> None:
    report = robot.report()
    assert report.identity.kind == "robot"
    assert report.identity.model == "UR10e"
    assert report.identity.serial.isdigit()
    assert report.identity.firmware.startswith("5.12")
    assert "ur_rtde 1." in report.identity.driver_version
    assert report.problems == ()
    assert report.clock_offset_s is not None
    for _ in range(5):  # a sample that arrives late makes the offset smaller, never larger
        sample = robot.state().sample
        assert sample.controller_time_s - sample.monotonic_s <= report.clock_offset_s + 0.05


@pytest.mark.skipif(
    not Path("/proc/self/timerslack_ns").exists(), reason="here a thread cannot say how late it may wake"
)
def test_the_threads_of_the_library_may_wake_late_and_no_others(monkeypatch: pytest.MonkeyPatch) -> None:
    vendor = pytest.importorskip("drivers.ur.vendor")  # the library has no package for some versions of Python
    slacks_ns: list[int] = []

    def slack_ns() -> int:
        return int(Path(f"/proc/{threading.get_native_id()}/timerslack_ns").read_text())

    def interface(*_: object) -> object:
        thread = threading.Thread(target=lambda: slacks_ns.append(slack_ns()))
        thread.start()
        thread.join()
        return object()

    mine_ns = slack_ns()
    monkeypatch.setattr("rtde_receive.RTDEReceiveInterface", interface)
    vendor.receive(address(51), 125.0, [])
    assert slacks_ns == [vendor.TIMER_SLACK_NS]
    assert slack_ns() == mine_ns < slacks_ns[0]


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
    pass_s(robot, 0.3)
    samples = robot.samples(begin, time.monotonic())
    steps_s = np.diff([s.controller_time_s for s in samples])
    assert np.all(steps_s > 0)
    assert np.mean(steps_s) > 0.007, "never more than 125 Hz"
    assert np.quantile(steps_s, 0.25) < 0.011, "nor less, but where the simulator was not scheduled"
    assert all(begin <= s.monotonic_s for s in samples)
    assert {s.safety for s in samples} == {SafetyState.NORMAL}


def test_stop_in_mid_motion(robot: RobotArm) -> None:
    start = robot.state().sample.joints_rad[0]
    move(robot, turned(robot, 4.0))
    wait_for(lambda: robot.state().sample.joints_rad[0] - start > 0.05)
    robot.stop()
    wait_for(lambda: not robot.is_moving())
    wait_for(lambda: robot.settle(SettleCriteria(window_s=0.2)).settled)
    done = robot.state().sample.joints_rad[0] - start
    assert 0.05 < done < 3.9
    pass_s(robot, 0.2)
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


@pytest.mark.parametrize("version", ["3.15", "5.25"])
def test_other_versions(version: str) -> None:
    model = "UR10" if version == "3.15" else "UR20"
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
