"""Motions of the arm that advance in time: trapezoidal in joint or tool space, speed, servo, stop, by hand."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from simulators.ur_controller import kinematics
from simulators.ur_controller.kinematics import Array, Model

MAX_JOINT_SPEED_RAD_S = 6.3  # twice the rating of the fastest joints
MAX_JOINT_STEP_RAD = 0.35  # within one cycle of a straight motion; more means that the posture has flipped


class MotionError(Exception):
    """The path cannot be followed (singularity, out of reach): a real controller stops protectively."""


class Motion(Protocol):
    """A motion in progress; after `advance` its fields hold the new state of the joints."""

    q: Array
    qd: Array
    qdd: Array
    done: bool
    waypoint: int

    def advance(self, dt_s: float) -> None:
        """Advance by dt_s. Raises MotionError."""
        ...


class Trapezoid:
    """A path parameter from 0 to `length`, starting and ending at rest, with limited speed and acceleration."""

    def __init__(self, length: float, speed: float, acceleration: float) -> None:
        speed, acceleration = max(abs(speed), 1e-6), max(abs(acceleration), 1e-6)
        self.length = length
        self._a = acceleration
        self._v = min(speed, math.sqrt(length * acceleration)) if length > 0 else 0.0
        self._ramp = self._v / acceleration
        self._cruise = length / self._v - self._ramp if self._v > 0 else 0.0
        self.duration = 2 * self._ramp + self._cruise if self._v > 0 else 0.0

    def at(self, t: float) -> tuple[float, float, float]:
        """Position, speed and acceleration at time t."""
        if t >= self.duration:
            return self.length, 0.0, 0.0
        if t < self._ramp:
            return 0.5 * self._a * t * t, self._a * t, self._a
        if t < self._ramp + self._cruise:
            return 0.5 * self._v * self._ramp + self._v * (t - self._ramp), self._v, 0.0
        left = self.duration - t
        return self.length - 0.5 * self._a * left * left, self._a * left, -self._a


class MoveJ:
    """A joint motion: all joints start and arrive together; the limits apply to the joint with the longest way."""

    def __init__(self, q0: Array, q1: Array, speed: float, acceleration: float) -> None:
        self.q, self.qd, self.qdd = q0.copy(), np.zeros(6), np.zeros(6)
        self.done = False
        self.waypoint = 0
        self._q0, self._q1 = q0.copy(), q1.copy()
        length = float(np.max(np.abs(q1 - q0)))
        self._direction = (q1 - q0) / length if length > 0 else np.zeros(6)
        self._profile = Trapezoid(length, speed, acceleration)
        self._t = 0.0

    def advance(self, dt_s: float) -> None:
        """Advance the motion by dt_s."""
        self._t += dt_s
        s, v, a = self._profile.at(self._t)
        self.done = self._t >= self._profile.duration
        self.q = self._q1.copy() if self.done else self._q0 + s * self._direction
        self.qd, self.qdd = v * self._direction, a * self._direction


class MoveL:
    """A linear motion: the tool moves straight and turns about one axis; joints follow by inverse kinematics."""

    def __init__(
        self, model: Model, q0: Array, T_base_tcp: Array, T_flange_tcp: Array, *, speed: float, acceleration: float
    ) -> None:
        self.q, self.qd, self.qdd = q0.copy(), np.zeros(6), np.zeros(6)
        self.done = False
        self.waypoint = 0
        self._model = model
        self._start = kinematics.forward(model, q0) @ T_flange_tcp
        self._goal = T_base_tcp
        self._T_tcp_flange = kinematics.rigid_inverse(T_flange_tcp)
        self._turn = kinematics.rotation_vector(self._start[:3, :3].T @ T_base_tcp[:3, :3])
        distance = float(np.linalg.norm(T_base_tcp[:3, 3] - self._start[:3, 3]))
        # Timed by its length, unless it is mostly a rotation: one radian counts as 0.25 m.
        length = max(distance, 0.25 * float(np.linalg.norm(self._turn)))
        self._profile = Trapezoid(length, speed, acceleration)
        self._t = 0.0
        if kinematics.inverse(model, T_base_tcp @ self._T_tcp_flange, q0) is None:
            raise MotionError("the goal of the straight motion is out of reach")

    def advance(self, dt_s: float) -> None:
        """Advance by dt_s. Raises MotionError at a singularity or out of reach."""
        self._t += dt_s
        s, _, _ = self._profile.at(self._t)
        fraction = s / self._profile.length if self._profile.length > 0 else 1.0
        T = np.eye(4)
        T[:3, :3] = self._start[:3, :3] @ kinematics.rotation(fraction * self._turn)
        T[:3, 3] = (1 - fraction) * self._start[:3, 3] + fraction * self._goal[:3, 3]
        goal = T @ self._T_tcp_flange
        q = kinematics.follow(self._model, goal, self.q)
        if q is None:
            q = kinematics.inverse(self._model, goal, self.q)
        if q is None or np.max(np.abs(q - self.q)) > MAX_JOINT_STEP_RAD:
            raise MotionError("the straight path runs through a singularity or out of reach")
        self.done = self._t >= self._profile.duration
        qd = np.zeros(6) if self.done else (q - self.q) / dt_s
        self.qdd = (qd - self.qd) / dt_s
        self.q, self.qd = q, qd


class Stop:
    """Decelerates all joints together to rest."""

    def __init__(self, q: Array, qd: Array, deceleration: float) -> None:
        self.q, self.qd = q.copy(), qd.copy()
        self.done = False
        self.waypoint = 0
        fastest = float(np.max(np.abs(qd)))
        self._left = fastest / max(abs(deceleration), 1e-6)
        self.qdd = -qd / self._left if self._left > 0 else np.zeros(6)

    def advance(self, dt_s: float) -> None:
        """Advance the motion by dt_s."""
        dt = min(dt_s, self._left)
        self.q = self.q + self.qd * dt + 0.5 * self.qdd * dt * dt
        self.qd = self.qd + self.qdd * dt
        self._left -= dt
        self.done = self._left <= 0
        if self.done:
            self.qd, self.qdd = np.zeros(6), np.zeros(6)


class Speed:
    """Keeps joint or tool velocities (speedJ, speedL, jog).

    A tool velocity is converted to joint velocities in each cycle.
    """

    def __init__(
        self,
        model: Model,
        q: Array,
        qd: Array,
        *,
        T_flange_tcp: Array,
        target: Array,
        acceleration: float,
        tool: bool,
    ) -> None:
        self.q, self.qd, self.qdd = q.copy(), qd.copy(), np.zeros(6)
        self.done = False
        self.waypoint = 0
        self._model, self._T_flange_tcp, self._tool = model, T_flange_tcp, tool
        self.target, self.acceleration = target, acceleration

    def advance(self, dt_s: float) -> None:
        """Advance by dt_s. Raises MotionError at a singularity or if a joint would be too fast."""
        goal = self.target
        if self._tool:
            chain = kinematics.frames(self._model, self.q)
            J = kinematics.jacobian(chain, (chain[6] @ self._T_flange_tcp)[:3, 3])
            if abs(float(np.linalg.det(J))) < 1e-5:
                raise MotionError("the tool velocity leads through a singularity")
            goal = np.linalg.solve(J, self.target)
            if np.max(np.abs(goal)) > MAX_JOINT_SPEED_RAD_S:
                raise MotionError("the tool velocity exceeds a joint's limit")
        # speedL's acceleration is that of the tool; joints get a generous multiple of it.
        step = max(self.acceleration, 1e-6) * dt_s * (4.0 if self._tool else 1.0)
        qd = self.qd + np.clip(goal - self.qd, -step, step)
        self.qdd = (qd - self.qd) / dt_s
        self.q, self.qd = self.q + qd * dt_s, qd


class Servo:
    """Follows a stream of joint targets with limited speed: servoJ and servoL."""

    def __init__(self, q: Array, qd: Array, target: Array, lookahead_s: float) -> None:
        self.q, self.qd, self.qdd = q.copy(), qd.copy(), np.zeros(6)
        self.done = False
        self.waypoint = 0
        self.target, self._lag_s = target, min(max(lookahead_s, 0.03), 0.2)

    def advance(self, dt_s: float) -> None:
        """Advance the motion by dt_s."""
        qd = np.clip((self.target - self.q) / self._lag_s, -3.14, 3.14)
        self.qdd = (qd - self.qd) / dt_s
        self.q, self.qd = self.q + qd * dt_s, qd


class Hand:
    """A hand that turns the joints (6,) evenly over some time, whatever else moves them."""

    def __init__(self, by_rad: Array, seconds: float) -> None:
        self._left_s = max(seconds, 1e-3)
        self._speed_rad_s = by_rad / self._left_s

    def advance(self, dt_s: float) -> Array:
        """How far the joints are turned within dt_s, (6,)."""
        part_s = min(dt_s, self._left_s)
        self._left_s -= part_s
        return self._speed_rad_s * part_s

    @property
    def done(self) -> bool:
        """Return whether the hand has let go."""
        return self._left_s <= 0.0


class Path:
    """Way points, each reached at rest (blending is not modelled); `waypoint` counts them."""

    def __init__(self, q0: Array, legs: Sequence[Callable[[Array], Motion]]) -> None:
        self.q, self.qd, self.qdd = q0.copy(), np.zeros(6), np.zeros(6)
        self.done = not legs
        self.waypoint = 0
        self._legs = list(legs)
        self._leg: Motion | None = None

    def advance(self, dt_s: float) -> None:
        """Advance by dt_s. Raises MotionError."""
        if self._leg is None:
            self._leg = self._legs[self.waypoint](self.q)
        self._leg.advance(dt_s)
        self.q, self.qd, self.qdd = self._leg.q, self._leg.qd, self._leg.qdd
        if self._leg.done:
            self._leg = None
            self.waypoint += 1
            self.done = self.waypoint >= len(self._legs)
