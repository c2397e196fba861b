"""Moves an arm and waits until it stands still; stops at once if the operator pauses the run."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from drivers.errors import ArmDepartedError, DeviceError, DeviceTimeoutError, SafetyStopError
from drivers.interfaces import RobotArm, SettleCriteria, SettleReport
from service.core.geometry import Array
from service.steps.context import StepContext, StepInterruptedError

# How far each joint may be from where it was sent. Controllers hold a thousandth of a radian, stepper motors several.
STANDS_RAD = 0.005
_POLL_S = 0.02
_POLL_AT_THE_END_S = 0.004  # when the arm may have settled: waiting longer delays the viewpoint


@dataclass(frozen=True, slots=True)
class MotionLimits:
    """Limits on the motion of an arm in a run."""

    speed_rad_s: float
    acceleration_rad_s2: float
    settle_timeout_s: float
    travel_timeout_s: float = 120.0


def settle_criteria(context: StepContext) -> SettleCriteria:
    """Return the protocol's definition of standing still."""
    settle = context.protocol.settle
    return SettleCriteria(
        window_s=settle.window_s,
        joint_speed_rad_s=settle.joint_speed_rad_s,
        tcp_speed_m_s=settle.tcp_speed_m_s,
        position_peak_to_peak_m=settle.position_peak_to_peak_m,
        rotation_peak_to_peak_rad=settle.rotation_peak_to_peak_rad,
    )


def move_and_settle(
    context: StepContext,
    robot: RobotArm,
    target_rad: Array,
    limits: MotionLimits,
    criteria: SettleCriteria,
    *,
    meanwhile: Callable[[], None] = lambda: None,
) -> SettleReport:
    """Move to joints (N,) and return when the pose stream is quiet. `meanwhile` is called after the motion started.

    Raises SafetyStopError, DeviceTimeoutError (the arm is stopped), StepInterruptedError (the arm stands still; it
    did not set out if the confirmation was too long ago).
    """
    with context.motion():
        try:
            robot.move_joints(
                target_rad, speed_rad_s=limits.speed_rad_s, acceleration_rad_s2=limits.acceleration_rad_s2
            )
            meanwhile()
            return _wait_settled(context, robot, limits, criteria)
        except StepInterruptedError:
            _stand_still(context, robot, criteria)
            raise
        except BaseException:  # also for defects and Ctrl-C, because the arm would move on unsupervised
            with suppress(DeviceError):
                robot.stop()
            raise


def require_there(robot_name: str, joints_rad: Array, sent_rad: Array, *, step: str) -> None:
    """Refuse to go on with an arm whose joints (N,) are not where they were sent.

    Poses and paths were checked for where it was sent, and for nowhere else. Raises ArmDepartedError.
    """
    away_rad = np.abs(np.asarray(joints_rad) - np.asarray(sent_rad))
    joint = int(np.argmax(away_rad))
    if away_rad[joint] > STANDS_RAD:
        raise ArmDepartedError(
            f"joint {joint + 1} of {robot_name} stands {away_rad[joint]:.3f} rad from where it was sent",
            where=step,
            remedy="Look at what moved it, and whether anybody is in reach; the step goes on after you confirm, and "
            "plans the motions anew from where the arm stands",
        )


def _wait_settled(
    context: StepContext, robot: RobotArm, limits: MotionLimits, criteria: SettleCriteria
) -> SettleReport:
    deadline_s = context.monotonic_s() + limits.travel_timeout_s + limits.settle_timeout_s
    stopped_s: float | None = None
    while True:
        context.checkpoint()
        safety = robot.state().sample.safety
        if not safety.may_move:
            raise SafetyStopError(
                f"the robot reports {safety.value.replace('_', ' ')}",
                where=context.step.id,
                remedy="Find and clear the cause at the robot; the step goes on after you confirm",
            )
        if stopped_s is None and not robot.is_moving():
            stopped_s = context.monotonic_s()
        if stopped_s is not None:
            report = robot.settle(criteria)
            if report.settled:
                return report
        now_s = context.monotonic_s()
        if now_s > deadline_s:
            raise DeviceTimeoutError(
                "the robot did not arrive and settle in time",
                where=context.step.id,
                remedy="Check for a vibrating mount or a drifting joint",
            )
        # The stop is noticed up to three polls after it happened.
        near_the_end = stopped_s is not None and now_s > stopped_s + criteria.window_s - 3 * _POLL_S
        context.wait(_POLL_AT_THE_END_S if near_the_end else _POLL_S)


def _stand_still(context: StepContext, robot: RobotArm, criteria: SettleCriteria) -> None:
    """Stop the arm and wait until it stands still, because only then may pages show 'paused'."""
    robot.stop()
    deadline_s = context.monotonic_s() + 10.0
    while not robot.settle(criteria).settled and context.monotonic_s() < deadline_s:
        context.wait(_POLL_S)
