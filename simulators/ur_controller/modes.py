"""The modes of a controller in the numbers of the RTDE guide, and the way from switched off to running."""

from __future__ import annotations

from enum import IntEnum

POWERING_S, BRAKES_S = 2.5, 1.5  # assumed: a real controller takes seconds for each


class RobotMode(IntEnum):
    """robot_mode."""

    NO_CONTROLLER = -1
    DISCONNECTED = 0
    CONFIRM_SAFETY = 1
    BOOTING = 2
    POWER_OFF = 3
    POWER_ON = 4
    IDLE = 5
    BACKDRIVE = 6
    RUNNING = 7
    UPDATING_FIRMWARE = 8


class SafetyMode(IntEnum):
    """safety_mode, and of safety_status what stops the arm beside it."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOP = 3
    RECOVERY = 4
    SAFEGUARD_STOP = 5
    SYSTEM_EMERGENCY_STOP = 6
    ROBOT_EMERGENCY_STOP = 7
    VIOLATION = 8
    FAULT = 9
    SYSTEM_THREE_POSITION_ENABLING_STOP = 11


class Runtime(IntEnum):
    """runtime_state."""

    STOPPED = 1
    PLAYING = 2
    PAUSED = 4


_STOPPED = 1 << 10  # due to safety
SAFETY_BITS = {
    SafetyMode.NORMAL: 1 << 0,
    SafetyMode.REDUCED: 1 << 1,
    SafetyMode.PROTECTIVE_STOP: 1 << 2 | _STOPPED,
    SafetyMode.RECOVERY: 1 << 3,
    SafetyMode.SAFEGUARD_STOP: 1 << 4 | _STOPPED,
    SafetyMode.SYSTEM_EMERGENCY_STOP: 1 << 5 | 1 << 7 | _STOPPED,
    SafetyMode.ROBOT_EMERGENCY_STOP: 1 << 6 | 1 << 7 | _STOPPED,
    SafetyMode.VIOLATION: 1 << 8 | _STOPPED,
    SafetyMode.FAULT: 1 << 9 | _STOPPED,
    SafetyMode.SYSTEM_THREE_POSITION_ENABLING_STOP: 1 << 11 | _STOPPED,
}
#: Modes in which a program may move the arm; of the others, those that only hold the program, and those that cut the
#: power.
FREE = (SafetyMode.NORMAL, SafetyMode.REDUCED)
HOLDING = (SafetyMode.SAFEGUARD_STOP, SafetyMode.SYSTEM_THREE_POSITION_ENABLING_STOP)
WITHOUT_POWER = (
    SafetyMode.SYSTEM_EMERGENCY_STOP, SafetyMode.ROBOT_EMERGENCY_STOP, SafetyMode.VIOLATION, SafetyMode.FAULT,
)  # fmt: skip


class StartUp:
    """Takes the arm from POWER_OFF by POWER_ON and IDLE to the mode that was asked for, each in its time.

    Args:
        speed_up: divides the times.
    """

    def __init__(self, speed_up: float) -> None:
        self._speed_up = speed_up
        self._goal: RobotMode | None = None
        self._due_s = 0.0

    @property
    def under_way(self) -> bool:
        """Return whether the mode will change by itself."""
        return self._goal is not None

    def begin(self, mode: RobotMode, goal: RobotMode, now_s: float) -> RobotMode:
        """Start towards a mode; returns the mode that begins at once."""
        if mode in (RobotMode.POWER_OFF, RobotMode.IDLE) and mode < goal:
            self._goal = goal
            self._due_s = now_s + (POWERING_S if mode is RobotMode.POWER_OFF else BRAKES_S) / self._speed_up
            return RobotMode.POWER_ON if mode is RobotMode.POWER_OFF else mode
        if self._goal is not None:
            self._goal = max(self._goal, goal)
        return mode

    def advance(self, mode: RobotMode, now_s: float) -> RobotMode:
        """The mode at this time."""
        if self._goal is None or now_s < self._due_s:
            return mode
        reached = RobotMode.IDLE if mode is RobotMode.POWER_ON else RobotMode.RUNNING
        goal, self._goal = self._goal, None
        return self.begin(reached, goal, now_s)

    def cancel(self) -> None:
        """Stay in the mode: the power was cut."""
        self._goal = None
