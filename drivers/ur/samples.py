"""Samples of the arm from ur_rtde's receive interface, the modes of the controller, and its inverse kinematics."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np

from drivers.arm.latch import Latch
from drivers.errors import (
    DeviceFaultError,
    DeviceRefusedError,
    DeviceUnavailableError,
    UnreachablePoseError,
)
from drivers.interfaces import Array, Payload, RobotSample, Sample, Transform
from drivers.ur import vendor as library
from drivers.ur.agreement import Agreement
from drivers.ur.safety import safety_state
from drivers.ur.tool import ToolWatch
from service.core.geometry import from_rotation_vector, to_rotation_vector

RESTART = "Restart the controller; see the log of the pendant if it happens again"
PLAYING = 2  # runtime_state
VARIABLES = (
    "timestamp",
    "actual_q",
    "actual_qd",
    "target_qd",
    "actual_TCP_pose",
    "actual_TCP_speed",
    "safety_status_bits",
    "robot_mode",
    "runtime_state",
    "target_speed_fraction",
    "payload",
    "payload_cog",
)
_ROBOT_MODES = {
    -1: "NO_CONTROLLER",
    0: "DISCONNECTED",
    1: "CONFIRM_SAFETY",
    2: "BOOTING",
    3: "POWER_OFF",
    4: "POWER_ON",
    5: "IDLE",
    6: "BACKDRIVE",
    7: "RUNNING",
    8: "UPDATING_FIRMWARE",
}
T = TypeVar("T")


class NoNumberError(ValueError):
    """The controller sent something that is not a number; it ends the stream, as a lost connection does."""


class SampleReader:
    """Reads whole samples from the receive interface, and shows their safety state to the latch.

    A sample with a value that is not a number raises NoNumberError, one that contradicts those before
    FrozenFieldError.
    """

    def __init__(self, latch: Latch) -> None:
        self._latch = latch
        self._controller_time_s = -1.0  # of the last sample
        self.receive: library.Receive | None = None  # None while the arm is not connected
        self.tool = ToolWatch(latch)
        self._agreement = Agreement()

    def read_from(self, receive: library.Receive) -> None:
        """Read from a new connection."""
        self.receive = receive
        self._controller_time_s = -1.0
        self._agreement.start()

    def read(self) -> RobotSample | None:
        """The newest sample; None if none came since the last call, or if the arm is not connected."""
        receive = self.receive
        if receive is None:
            return None
        # Each getter locks separately: read the set again if a new package arrived in between.
        for _ in range(3):
            before_s = receive.getTimestamp()
            if before_s == self._controller_time_s:
                return None
            sample, payload = _take(receive, before_s)
            if receive.getTimestamp() == before_s:
                self._controller_time_s = before_s
                self._latch.see(sample.safety, sample.monotonic_s)
                self._agreement.see(
                    sample.controller_time_s,
                    sample.joints_rad,
                    sample.joint_velocities_rad_s,
                    sample.target_velocities_rad_s * speed_fraction(receive),
                    sample.T_base_flange[:3, 3],
                    sample.tcp_speed_m_s,
                    sample.safety,
                )
                return self._of_flange(sample, payload)
        return None

    def _of_flange(self, sample: RobotSample, payload: Payload) -> RobotSample:
        """A sample that holds the pose of the tool's centre point, with that of the flange instead, and the tool."""
        T_base_flange = self.tool.flange(sample.joints_rad, sample.T_base_flange, payload)
        return replace(sample, T_base_flange=T_base_flange, T_flange_tcp=self.tool.T_flange_tcp, payload=payload)


def stated_fields(receive: library.Receive) -> Sample:
    """The fields of the newest sample as RTDE names them; without those that hold something that is no number."""
    getters: dict[str, Callable[[], float | list[float]]] = {
        "timestamp": receive.getTimestamp,
        "actual_q": receive.getActualQ,
        "actual_qd": receive.getActualQd,
        "target_qd": receive.getTargetQd,
        "actual_TCP_pose": receive.getActualTCPPose,
        "actual_TCP_speed": receive.getActualTCPSpeed,
        "safety_status_bits": receive.getSafetyStatusBits,
        "robot_mode": receive.getRobotMode,
        "runtime_state": receive.getRuntimeState,
        "target_speed_fraction": receive.getTargetSpeedFraction,
        "payload": receive.getPayload,
        "payload_cog": receive.getPayloadCog,
    }
    said = {name: getters[name]() for name in VARIABLES}
    fields = {name: tuple(value) if isinstance(value, list) else (value,) for name, value in said.items()}
    return Sample(
        source="RTDE", fields={name: value for name, value in fields.items() if all(map(math.isfinite, value))}
    )


def _take(receive: library.Receive, controller_time_s: float) -> tuple[RobotSample, Payload]:
    """A sample with the pose of the tool's centre point, and the payload. Raises NoNumberError."""
    _numbers("timestamp", controller_time_s)
    x, y, z = _numbers("payload_cog", *receive.getPayloadCog())
    sample = RobotSample(
        controller_time_s=controller_time_s,
        monotonic_s=time.monotonic(),
        joints_rad=np.array(_numbers("actual_q", *receive.getActualQ())),
        joint_velocities_rad_s=np.array(_numbers("actual_qd", *receive.getActualQd())),
        target_velocities_rad_s=np.array(_numbers("target_qd", *receive.getTargetQd())),
        T_base_flange=from_rotation_vector(np.array(_numbers("actual_TCP_pose", *receive.getActualTCPPose()))),
        tcp_speed_m_s=math.hypot(*_numbers("actual_TCP_speed", *receive.getActualTCPSpeed())[:3]),
        safety=safety_state(receive.getSafetyStatusBits()),
    )
    (mass_kg,) = _numbers("payload", receive.getPayload())
    return sample, Payload(mass_kg, (x, y, z))


def _numbers(field: str, *values: float) -> tuple[float, ...]:
    """The values of a field. Raises NoNumberError if one is not finite."""
    if all(map(math.isfinite, values)):
        return values
    raise NoNumberError(f"the controller sends no number for {field}")


def speed_fraction(receive: library.Receive) -> float:
    """How far the speed slider is up, 0 … 1. Raises NoNumberError."""
    return _numbers("target_speed_fraction", receive.getTargetSpeedFraction())[0]


def robot_mode(receive: library.Receive) -> str:
    """The mode of the arm in the vendor's words, such as RUNNING."""
    mode = receive.getRobotMode()
    return _ROBOT_MODES.get(mode, str(mode))


def joints_for(
    control: library.Control, T_base_flange: Transform, T_flange_tcp: Transform, near: list[float], where: str
) -> Array:
    """The joints (6,), in radians, nearest to `near`, that bring the flange to a pose.

    Checks first that a solution exists, because an unreachable pose would end the control script.

    Raises:
        UnreachablePoseError: there is no solution, or it lies beyond the safety limits.
        DeviceFaultError: the controller gave no answer.
    """
    pose = to_rotation_vector(T_base_flange @ T_flange_tcp).tolist()
    if not control.getInverseKinematicsHasSolution(pose, near):
        x, y, z = T_base_flange[:3, 3]
        raise UnreachablePoseError(
            f"the arm cannot reach the flange pose at ({x:.3f}, {y:.3f}, {z:.3f}) m in its base frame",
            where=where,
            remedy="Choose another viewpoint or move the station",
        )
    joints = control.getInverseKinematics(pose, near)
    if len(joints) != 6:
        raise DeviceFaultError("inverse kinematics returned no joints", where=where, remedy=RESTART)
    if not control.isJointsWithinSafetyLimits(joints):
        raise UnreachablePoseError(
            "the pose lies beyond the controller's safety limits",
            where=where,
            remedy="Choose another viewpoint, or widen the limits on the pendant if that is safe",
        )
    return np.asarray(joints, dtype=np.float64)


def joint_values(values: Array, where: str) -> list[float]:
    """Six joints, in radians, as the vendor's library takes them. Raises DeviceRefusedError for anything else."""
    joints = np.asarray(values, dtype=np.float64)
    if joints.shape != (6,) or not np.all(np.isfinite(joints)):
        raise DeviceRefusedError(
            f"joints must be six finite numbers, not {values}", where=where, remedy="Choose another viewpoint"
        )
    return [float(v) for v in joints]


def require_open(part: T | None, where: str) -> T:
    """A part of the connection. Raises DeviceUnavailableError if the arm is not connected."""
    if part is None:
        raise DeviceUnavailableError("the robot is not connected", where=where, remedy="Open it first")
    return part
