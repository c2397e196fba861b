"""The KUKA driver in its hosted process against the simulated controller, over the real wire."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import time
from collections.abc import Callable, Generator

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivers.errors import (
    DeviceRefusedError,
    DeviceUnavailableError,
    LeaveNeededError,
    SafetyStopError,
    UnreachablePoseError,
)
from drivers.host.hosted_device import hosted
from drivers.interfaces import Array, Payload, RobotArm, SafetyState, SettleCriteria
from drivers.kuka import KukaConfig
from service.core.arms import arm_model
from service.core.arms import flange_pose as forward
from service.core.geometry import inverse, rotation_angle_rad, transform
from service.core.seven_axes import nearest_posture, postures
from simulators.kuka_controller.kinematics import MODELS, frames
from tests.support.arms.confirming import confirm_and
from tests.support.arms.kuka_simulator import Controller, pendant, simulated_kuka
from tests.support.arms.sunrise import sunrise_engine
from tests.support.arms.ur_simulator import address
from tests.support.processes.hosts import driver_pid
from tests.support.processes.lateness import Lateness
from tests.support.processes.waiting import until
from tests.support.rig.patience import PATIENT_KUKA

ENGINE = pytest.param(sunrise_engine, marks=pytest.mark.packages("default-jdk-headless"))
both = pytest.mark.parametrize("controller", [simulated_kuka, ENGINE])
PAYLOAD = Payload(1.6, (0.0, 0.0, 0.08))
# At 1 rad/s: 0.3 s until its client is silent, 0.3 s until that is noticed, and the braking.
STOPPED_BY_RAD, LATE_TIMES = 1.2, 5
TCP = transform(Rotation.from_euler("z", 0.3), np.array([0.01, 0.0, 0.1]))


@contextlib.contextmanager
def opened(host: str, **limits: float) -> Generator[RobotArm]:
    config = KukaConfig.model_validate({"host": host, **PATIENT_KUKA, **limits})
    arm = hosted(RobotArm, "drivers.kuka:DRIVER", config, call_timeout_s=60, name="robot")
    try:
        arm.open()
        arm.let_move("Ada", time.monotonic())
        yield arm
    finally:
        arm.close()


def fresh(arm: RobotArm) -> bool:
    """Whether the stream is up to date again."""
    try:
        arm.state()
    except DeviceUnavailableError:
        return False
    return True


def wait_for(condition: Callable[[], bool]) -> None:
    until(condition, "waited in vain", every_s=0.02)


def move(arm: RobotArm, joints: Array) -> None:
    arm.move_joints(joints, speed_rad_s=1.0, acceleration_rad_s2=1.4)


def travel(arm: RobotArm, joints: Array) -> None:
    move(arm, joints)
    wait_for(lambda: not arm.is_moving())


def turned(arm: RobotArm, by_rad: float) -> Array:
    joints = arm.state().sample.joints_rad.copy()
    joints[0] += by_rad
    return joints


@pytest.mark.slow
@both
def test_a_day_without_trouble(controller: Controller) -> None:
    host = address(71)
    with controller(host), opened(host) as arm:
        report = arm.report()
        assert (report.identity.model, report.identity.driver, report.problems) == ("LBR Med 14", "kuka_sunrise", ())
        arm.configure(PAYLOAD, TCP)
        with pytest.raises(DeviceRefusedError, match=r"80(\.0)? kg"):
            arm.configure(Payload(80.0, (0.0, 0.0, 0.0)), TCP)
        start = arm.state().sample
        goal = start.T_base_flange @ transform(
            Rotation.from_euler("xyz", [0.1, -0.1, 0.2]), np.array([0.05, 0, 0.02])
        )
        joints = arm.solve_ik(goal, start.joints_rad)
        move(arm, joints)
        assert arm.is_moving()
        assert not arm.settle(SettleCriteria()).settled
        wait_for(lambda: not arm.is_moving())
        wait_for(lambda: arm.settle(SettleCriteria()).settled)
        gap = inverse(goal) @ arm.settle(SettleCriteria()).T_base_flange
        assert np.linalg.norm(gap[:3, 3]) < 1e-6
        assert rotation_angle_rad(gap) < 1e-6
        far = goal.copy()
        far[0, 3] += 2.0
        with pytest.raises(UnreachablePoseError):
            arm.solve_ik(far, joints)
        move(arm, turned(arm, 1.5))
        arm.stop()
        assert not arm.is_moving()
        travel(arm, turned(arm, 0.05))


@both
def test_a_stop_latches_until_a_person_confirms_and_nothing_clears_it_by_itself(controller: Controller) -> None:
    host = address(72)
    with controller(host), opened(host) as arm:
        move(arm, turned(arm, 1.5))
        pendant(host, "stop external_stop")
        with pytest.raises(SafetyStopError):
            wait_for(lambda: not arm.is_moving())
        assert arm.state().sample.safety is SafetyState.SAFEGUARD_STOP
        with pytest.raises(SafetyStopError):
            arm.let_move("Ada", time.monotonic())
        arm.open()
        assert arm.state().sample.safety is SafetyState.SAFEGUARD_STOP, "reconnecting does not help"
        before = time.monotonic()
        pendant(host, "release")
        wait_for(lambda: arm.state().sample.safety is SafetyState.NORMAL)
        stood = arm.state().sample.joints_rad
        with pytest.raises(SafetyStopError, match="nobody has confirmed since"):
            move(arm, turned(arm, 0.1))
        with pytest.raises(SafetyStopError):
            arm.let_move("Ada", before - 1.0)
        np.testing.assert_array_equal(arm.state().sample.joints_rad, stood)
        arm.let_move("Ada", time.monotonic())
        travel(arm, turned(arm, 0.1))


@pytest.mark.realtime
@both
def test_a_moving_arm_that_nobody_looks_at_is_stopped(controller: Controller) -> None:
    host = address(73)
    with controller(host, patience_s=0), opened(host, unattended_s=0.3) as arm, Lateness() as lateness:
        start = arm.state().sample.joints_rad[0]
        confirm_and(arm, lambda: move(arm, turned(arm, 2.5)))
        time.sleep(1.5)
        with pytest.raises(LeaveNeededError, match="nobody had looked"):
            wait_for(lambda: not arm.is_moving())
        assert arm.state().sample.joints_rad[0] - start < STOPPED_BY_RAD + LATE_TIMES * lateness.worst_s
        with pytest.raises(LeaveNeededError):
            move(arm, turned(arm, 0.1))
        confirm_and(arm, lambda: travel(arm, turned(arm, 0.1)))


@pytest.mark.realtime
@both
def test_a_driver_that_stands_still_sends_no_heartbeat_and_the_arm_stops(controller: Controller) -> None:
    host = address(77)
    with controller(host, patience_s=0), opened(host) as arm, Lateness() as lateness:
        driver = driver_pid(arm)
        start = arm.state().sample.joints_rad[0]
        confirm_and(arm, lambda: move(arm, turned(arm, 2.5)))
        os.kill(driver, signal.SIGSTOP)
        try:
            time.sleep(1.5)
        finally:
            os.kill(driver, signal.SIGCONT)
        wait_for(lambda: fresh(arm))
        with pytest.raises(LeaveNeededError, match="no line of its client"):
            wait_for(lambda: not arm.is_moving())
        assert arm.state().sample.joints_rad[0] - start < STOPPED_BY_RAD + LATE_TIMES * lateness.worst_s
        with pytest.raises(LeaveNeededError):
            move(arm, turned(arm, 0.1))
        confirm_and(arm, lambda: travel(arm, turned(arm, 0.1)))


@pytest.mark.slow
def test_an_arm_whose_brakes_closed_moves_once_they_are_released() -> None:
    host = address(78)
    with simulated_kuka(host, "--speed-up", "4"), opened(host) as arm:
        travel(arm, turned(arm, 0.1))
        closed_s = arm.state().sample.controller_time_s + 5.0  # the brakes close after 20 s, here 5 s
        wait_for(lambda: arm.state().sample.controller_time_s > closed_s)
        start = arm.state().sample.joints_rad
        goal = turned(arm, 2.5)
        begin = time.monotonic()
        move(arm, goal)
        assert arm.is_moving()
        assert not arm.settle(SettleCriteria()).settled, "it stands, but has not arrived"
        wait_for(lambda: not arm.is_moving())
        np.testing.assert_allclose(arm.state().sample.joints_rad, goal, atol=1e-4)
        left = [s for s in arm.samples(begin, time.monotonic()) if np.any(s.joints_rad != start)]
        assert left[0].monotonic_s - begin > 0.12, "the brakes take 0.6 s, here 0.15 s"


def test_a_wrong_load_is_felt_as_a_collision() -> None:
    host = address(74)
    with simulated_kuka(host, "--true-load-kg", "1.6"), opened(host) as arm:
        with pytest.raises(SafetyStopError):
            travel(arm, turned(arm, 0.5))
        pendant(host, "release")
        wait_for(lambda: arm.state().sample.safety is SafetyState.NORMAL)
        arm.let_move("Ada", time.monotonic())
        arm.configure(PAYLOAD, TCP)
        travel(arm, turned(arm, 0.2))


def test_t1_keeps_the_flange_below_250_mm_per_second() -> None:
    host = address(75)
    with simulated_kuka(host, "--mode", "T1"), opened(host) as arm:
        assert any("T1" in problem for problem in arm.report().problems)
        begin = time.monotonic()
        travel(arm, turned(arm, 0.8))
        fastest = max(s.tcp_speed_m_s for s in arm.samples(begin, time.monotonic()))
        assert 0.2 < fastest < 0.26


def test_a_lost_link_is_unavailable_and_opens_again() -> None:
    host = address(76)
    plan = json.dumps([{"device": "robot", "on": "move", "kind": "drop"}])
    with simulated_kuka(host, "--faults", plan), opened(host) as arm:
        with pytest.raises(DeviceUnavailableError):
            travel(arm, turned(arm, 1.0))
        arm.open()
        with pytest.raises(LeaveNeededError):
            move(arm, turned(arm, 0.1))
        arm.let_move("Ada", time.monotonic())
        travel(arm, turned(arm, 0.1))


def test_seven_axes_reach_every_pose_within_their_limits() -> None:
    arm, random = arm_model("LBR Med 14"), np.random.default_rng(7)
    limits = np.array(arm.limits_rad)
    for _ in range(100):
        q = random.uniform(-limits, limits)
        T = frames(MODELS[arm.name], q)[-1]
        np.testing.assert_allclose(forward(arm, q), T, atol=1e-12)
        found = postures(arm, T)
        assert np.all(np.abs(found) <= limits + 1e-9)
        for posture in found[::25]:
            np.testing.assert_allclose(frames(MODELS[arm.name], posture)[-1], T, atol=1e-9)
        nearest = nearest_posture(arm, T, q)
        assert nearest is not None
        np.testing.assert_allclose(nearest, q, atol=1e-6)


def test_the_elbow_moves_clear_of_a_limit() -> None:
    arm = arm_model("LBR Med 14")
    free = np.array([0.0, 0.6, 0.0, -1.2, 0.0, 0.9, 0.0])
    at_limit = postures(arm, forward(arm, free))
    room = np.array(arm.limits_rad) - np.abs(at_limit)
    tight = at_limit[int(np.argmin(room.min(axis=1)))]
    found = nearest_posture(arm, forward(arm, free), free)
    assert found is not None
    assert (np.array(arm.limits_rad) - np.abs(found)).min() > (np.array(arm.limits_rad) - np.abs(tight)).min()
