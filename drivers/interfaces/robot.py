"""The interface of a robot arm."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from drivers.interfaces.device import Array, Device, Transform


class SafetyState(Enum):
    """State of the controller's safety system; only a person can clear a stop."""

    NORMAL = "normal"
    REDUCED = "reduced"
    PROTECTIVE_STOP = "protective_stop"
    SAFEGUARD_STOP = "safeguard_stop"
    EMERGENCY_STOP = "emergency_stop"
    FAULT = "fault"
    UNKNOWN = "unknown"

    @property
    def may_move(self) -> bool:
        """Return whether motion may be commanded in this state."""
        return self in (SafetyState.NORMAL, SafetyState.REDUCED)


@dataclass(frozen=True, slots=True)
class Abandoned:
    """Says what becomes of a motion whose program died: the controller notices, and the arm brakes."""

    noticed_after_s: float  # until the controller ends the motion
    rest_within_s: float  # longest time that the site allows until the arm stands


@dataclass(frozen=True, slots=True)
class Payload:
    """The load on the flange: camera, lens and mount."""

    mass_kg: float
    centre_of_gravity_m: tuple[float, float, float]  # in the flange frame


@dataclass(frozen=True, slots=True)
class RobotSample:
    """One sample of the controller's stream."""

    controller_time_s: float
    monotonic_s: float  # host time.monotonic() at arrival
    joints_rad: Array  # (N,), one value an axis; metres for an axis that slides
    joint_velocities_rad_s: Array
    target_velocities_rad_s: Array
    T_base_flange: Transform  # as reported by the controller, with the tool offset removed
    tcp_speed_m_s: float
    safety: SafetyState
    T_flange_tcp: Transform | None = None  # (4, 4), the tool that the controller held; None: it does not tell
    payload: Payload | None = None  # that the controller reckoned with; None: it does not tell


@dataclass(frozen=True, slots=True)
class RobotState:
    """The newest sample with the controller's modes."""

    sample: RobotSample
    robot_mode: str
    program_running: bool
    speed_fraction: float


@dataclass(frozen=True, slots=True)
class SettleCriteria:
    """When an arm counts as standing still.

    The defaults suit a UR10e with a camera on its flange: for a 60-megapixel camera with a 50 mm lens at 0.6 m,
    20 µm are half a pixel and 5 millidegrees about one.
    """

    window_s: float = 0.5
    joint_speed_rad_s: float = 0.001
    tcp_speed_m_s: float = 0.0002
    position_peak_to_peak_m: float = 0.00002
    rotation_peak_to_peak_rad: float = 0.0000873


@dataclass(frozen=True, slots=True)
class SettleReport:
    """Says whether the last window of the pose stream meets the settle criteria, with the measured values."""

    settled: bool
    samples: int
    joint_speed_rad_s: float
    tcp_speed_m_s: float
    position_peak_to_peak_m: float
    rotation_peak_to_peak_rad: float
    T_base_flange: Transform  # mean over the window
    joints_rad: Array
    ringing_s: float = 0.0  # from the end of the commanded motion to the last sample above a speed limit


class RobotArm(Device, Protocol):
    """A device that changes the pose of the camera to the specimen: an arm, or a turntable, of N axes.

    The base frame is rigid with the specimen, the flange with the camera. Where a turntable carries the specimen, the
    base frame turns.

    Motion is asynchronous, so that `stop` always works, and needs a person's permission (`let_move`).
    """

    def let_move(self, confirmed_by: str, not_before_monotonic_s: float) -> None:
        """Permit motion after a person has checked the arm and confirmed; clears stops that are over.

        A tool or payload that somebody else has changed is set again as by `configure`.

        The permission is needed after `open`, after any safety stop in the stream, and after the controller's program
        ended unexpectedly. The caller must have the person's confirmation on record.

        Args:
            confirmed_by: name of the person.
            not_before_monotonic_s: host time.monotonic() shortly before the person confirmed.

        Raises:
            SafetyStopError, LeaveNeededError, ToolChangedError: a stop, an unexpected end of the program, or a
                change of the tool, after that time.
        """
        ...

    def configure(self, payload: Payload, T_flange_tcp: Transform) -> None:
        """Set the payload and the tool centre point, and verify both by reading them back."""
        ...

    def state(self) -> RobotState:
        """Return the newest state. Raises DeviceUnavailableError if the stream is stale."""
        ...

    def samples(self, start_monotonic_s: float, end_monotonic_s: float) -> tuple[RobotSample, ...]:
        """Return the buffered samples (at least the last 10 s) between two host times, oldest first.

        Reading samples does not count as supervising the arm: a moving arm that is only observed this way is stopped.

        Raises ToolChangedError once the tool was changed, until a person has confirmed.
        """
        ...

    def solve_ik(self, T_base_flange: Transform, near_rad: Array) -> Array:
        """Return the controller's joint solution for a flange pose that is closest to `near_rad`, in radians.

        Raises UnreachablePoseError if there is none.
        """
        ...

    def move_joints(self, target_rad: Array, *, speed_rad_s: float, acceleration_rad_s2: float) -> None:
        """Start a joint motion and return at once.

        Raises:
            SafetyStopError: a stop is active, or nobody has confirmed since the last one.
            LeaveNeededError: nobody has permitted motion yet.
        """
        ...

    def stop(self) -> None:
        """Decelerate to a standstill. This is a software stop, not an emergency stop."""
        ...

    def is_moving(self) -> bool:
        """Return whether the last motion is still under way. Raises the error that interrupted it, if any."""
        ...

    def settle(self, criteria: SettleCriteria) -> SettleReport:
        """Judge the last window of the pose stream against the criteria. Returns at once; meant to be polled."""
        ...
