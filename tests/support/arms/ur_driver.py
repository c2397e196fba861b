"""The driver of Universal Robots in its hosted process, opened for tests on a simulated controller."""

from __future__ import annotations

import contextlib
import json
import socket
import time
from collections.abc import Callable, Generator, Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from drivers.host.hosted_device import hosted
from drivers.interfaces import Array, Payload, RobotArm
from drivers.ur import UrConfig
from service.core.geometry import transform
from tests.support.arms.ur_simulator import address, simulated_ur
from tests.support.processes.waiting import until
from tests.support.rig.patience import PATIENT_UR

SPEED_UP = "3"
SPEED, ACCELERATION = 1.05, 1.4
T_FLANGE_TCP = transform(Rotation.from_euler("z", 0.3), np.array([0.01, 0.0, 0.1]))
PAYLOAD = Payload(1.6, (0.0, 0.0, 0.08))


@contextlib.contextmanager
def opened(host: str, **config: float) -> Generator[RobotArm]:
    section = UrConfig.model_validate({"host": host, **PATIENT_UR, **config})
    arm = hosted(RobotArm, "drivers.ur:DRIVER", section, call_timeout_s=60, name="robot")
    try:
        arm.open()
        let_move(arm)
        yield arm
    finally:
        arm.close()


def let_move(arm: RobotArm) -> None:
    arm.let_move("Ada", time.monotonic())


def faulty(number: int, *faults: Mapping[str, object]) -> contextlib.AbstractContextManager[dict[str, str]]:
    plan = json.dumps([{"device": "robot", **fault} for fault in faults])
    return simulated_ur(address(number), "--speed-up", SPEED_UP, "--faults", plan)


def dashboard(host: str, *orders: str) -> list[str]:
    with socket.create_connection((host, 29999), timeout=90) as connection, connection.makefile("rw") as lines:
        lines.readline()
        answers: list[str] = []
        for order in orders:
            lines.write(order + "\n")
            lines.flush()
            answers.append(lines.readline().strip())
        return answers


def wait_for(condition: Callable[[], bool]) -> None:
    until(condition, "waited in vain", every_s=0.02)


def pass_s(arm: RobotArm, seconds: float) -> None:
    """Let so much time of the controller pass."""
    end_s = arm.state().sample.controller_time_s + seconds
    wait_for(lambda: arm.state().sample.controller_time_s >= end_s)


def move(arm: RobotArm, joints: Array) -> None:
    arm.move_joints(joints, speed_rad_s=SPEED, acceleration_rad_s2=ACCELERATION)


def travel(arm: RobotArm, joints: Array) -> None:
    move(arm, joints)
    wait_for(lambda: not arm.is_moving())


def turned(arm: RobotArm, by_rad: float) -> Array:
    joints = arm.state().sample.joints_rad.copy()
    joints[0] += by_rad
    return joints
