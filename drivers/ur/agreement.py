"""Watches that the fields of the stream agree while the arm moves: one that has frozen contradicts the others.

Only what the others tell of is watched: speeds must be those at which joints and tool move. A safety state, a mode,
the speed slider and the payload are constant for hours in a sound arm, so that nothing tells whether they are frozen;
nor does a target velocity of zero, since a hand may turn the joints.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from drivers.interfaces import Array, SafetyState

WINDOW_S = 2.0  # over which motion and speeds are compared
GAP_S = 0.025  # without samples, after which the comparison begins anew: nobody knows how it moved meanwhile
LEAST_STEPS = 12  # with motion or speed in the window: of a shorter motion the samples tell too little
_STILL = 1e-4  # rad or m in a step
# Motion and integrated speed agree within these, and within a factor: speeds are filtered and lag behind.
SLACK_RAD, SLACK_M, FACTOR = 0.05, 0.05, 3.0
# From one sample to the next, beyond what the joints explain for the longest arm: the tool was changed, not moved.
_JUMP_M, _REACH_M = 0.03, 2.5


class FrozenFieldError(ValueError):
    """A field contradicts the others; it ends the stream, as a lost connection does."""


class Agreement:
    """Compares over the last WINDOW_S how joints and tool moved with the speeds that the controller told."""

    def __init__(self) -> None:
        # Controller time, joints (6,), integrals of their speeds and targets (6,), path of the tool and integral of
        # its speed, and in how many steps anything moved or told of a speed.
        self._window: deque[tuple[float, Array, Array, Array, float, float, int]] = deque()
        self._last: tuple[Array, Array, Array, float] | None = None  # speeds, targets, position, speed of the tool

    def start(self) -> None:
        """Begin anew."""
        self._window.clear()
        self._last = None

    def see(
        self,
        at_s: float,
        joints_rad: Array,
        speeds_rad_s: Array,
        targets_rad_s: Array,
        position_m: Array,
        tcp_speed_m_s: float,
        safety: SafetyState,
    ) -> None:
        """Take the next sample; targets are those that the speed slider leaves. Raises FrozenFieldError."""
        last, self._last = self._last, (speeds_rad_s, targets_rad_s, position_m, tcp_speed_m_s)
        newest = self._window[-1] if self._window else None
        moved_m = 0.0 if last is None else float(np.linalg.norm(position_m - last[2]))
        turned_m = 0.0 if newest is None else _REACH_M * float(np.sum(np.abs(joints_rad - newest[1])))
        if newest is None or last is None or not 0.0 < at_s - newest[0] <= GAP_S or moved_m > _JUMP_M + turned_m:
            self._window.clear()
            self._window.append((at_s, joints_rad, np.zeros(6), np.zeros(6), 0.0, 0.0, 0))
            return
        step_s = at_s - newest[0]
        told = newest[2] + step_s * (last[0] + speeds_rad_s) / 2
        wanted = newest[3] + step_s * (last[1] + targets_rad_s) / 2
        path_m, told_m = newest[4] + moved_m, newest[5] + step_s * (last[3] + tcp_speed_m_s) / 2
        changes = (joints_rad - newest[1], told - newest[2], wanted - newest[3], moved_m, told_m - newest[5])
        steps = newest[6] + any(float(np.max(np.abs(one))) > _STILL for one in changes)
        self._window.append((at_s, joints_rad, told, wanted, path_m, told_m, steps))
        while self._window[0][0] < at_s - WINDOW_S:
            self._window.popleft()
        began = self._window[0]
        if steps - began[6] < LEAST_STEPS:
            return
        turned_rad = np.abs(joints_rad - began[1])
        _compare("actual_qd", np.abs(told - began[2]), turned_rad, SLACK_RAD, "rad")
        if safety is SafetyState.NORMAL:  # in others the controller may move more slowly than it wants to
            beyond = np.abs(wanted - began[3]) - FACTOR * turned_rad
            if float(np.max(beyond)) > SLACK_RAD:
                raise FrozenFieldError("the controller's target_qd is not followed by the joints: it may be frozen")
        _compare("actual_TCP_speed", np.array([told_m - began[5]]), np.array([path_m - began[4]]), SLACK_M, "m")


def _compare(field: str, told: Array, moved: Array, slack: float, unit: str) -> None:
    """Hold the integral of a speed against the motion, of each joint or of the tool. Raises FrozenFieldError."""
    apart = np.maximum(told - FACTOR * moved, moved - FACTOR * told)
    worst = int(np.argmax(apart))
    if apart[worst] > slack:
        raise FrozenFieldError(
            f"the controller's {field} does not fit the motion: it tells of {told[worst]:.2f} {unit} where there "
            f"were {moved[worst]:.2f} {unit}; a field may be frozen"
        )
