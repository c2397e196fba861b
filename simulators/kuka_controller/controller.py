"""The state of a simulated KUKA controller: joints and their motion, operating mode, safety, brakes and load."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

import numpy as np

from simulators.faults import Fault, FaultPlan
from simulators.kuka_controller import kinematics
from simulators.kuka_controller.kinematics import Array, Model

_LOG = logging.getLogger(__name__)

T1_SPEED_M_S = 0.250
HEARTBEAT_S = 0.3
BRAKE_IDLE_S, BRAKE_RELEASE_S = 20.0, 0.6
STOP_RAD_S2 = 6.0  # deceleration of a stop
LOAD_TOLERANCE_KG = 1.0  # a larger error of the load looks like a collision to the torque sensors
SAFETY = ("normal", "protective_stop", "external_stop", "enabling_switch", "emergency_stop", "fault")
MODES = ("T1", "T2", "AUT")


class RefusedError(Exception):
    """A request that the controller does not carry out: its code on the wire, and why."""

    def __init__(self, code: str, what: str) -> None:
        super().__init__(what)
        self.code = code


@dataclass(frozen=True, slots=True)
class MotionEnd:
    """How a motion ended; `code` is empty if it arrived."""

    motion: int
    code: str = ""
    what: str = ""


@dataclass
class _Motion:
    """A joint motion in progress: a trapezoid along the straight line from `start` to `goal`."""

    number: int
    start: Array
    goal: Array
    speed: float
    acceleration: float
    waits_s: float  # until the brakes are released
    s: float = 0.0  # way along the longest joint, rad
    v: float = 0.0
    stopping: MotionEnd | None = None

    @property
    def length(self) -> float:
        """Way of the joint that moves most, rad."""
        return float(np.max(np.abs(self.goal - self.start)))

    def advance(self, dt_s: float, speed_limit: float) -> bool:
        """Advance by dt_s; returns whether it is over."""
        if self.stopping is not None:
            self.v = max(0.0, self.v - STOP_RAD_S2 * dt_s)
        else:
            braking = math.sqrt(2 * self.acceleration * max(0.0, self.length - self.s))
            target = min(self.speed, speed_limit, braking)
            self.v = min(target, self.v + self.acceleration * dt_s)
        self.s = min(self.length, self.s + self.v * dt_s)
        if self.stopping is not None:
            return self.v == 0.0 or self.s >= self.length
        if self.length - self.s < 1e-6 or (self.v < 1e-5 and self.length - self.s < 1e-4):
            self.s = self.length
            return True
        return False

    @property
    def q(self) -> Array:
        """Joints (7,) now."""
        return self.start + (self.s / self.length if self.length > 0 else 1.0) * (self.goal - self.start)


class Controller:
    """One controller with its arm. Time is in seconds since start-up; `speed_up` shortens motions and waits."""

    def __init__(
        self, model: Model, *, joints: Array, serial: str, faults: FaultPlan, device: str, speed_up: float = 1.0,
        true_load_kg: float | None = None, heartbeat_s: float = HEARTBEAT_S,
    ) -> None:  # fmt: skip
        self.model, self.serial, self.faults, self.device = model, serial, faults, device
        self.speed_up, self.true_load_kg, self.heartbeat_s = speed_up, true_load_kg, heartbeat_s
        self.time_s = 0.0
        self.mode, self.safety, self.locked = "AUT", "normal", True
        self.ready, self.override = True, 1.0
        self.software = "Sunrise.OS simulated"
        self.q = joints.copy()
        self.tool: dict[str, object] = {
            "mass_kg": 0.0, "centre_m": [0.0] * 3, "tcp_xyz_m": [0.0] * 3, "tcp_abc_rad": [0.0] * 3,
        }  # fmt: skip
        self.motion: _Motion | None = None
        self.stream_fault: Fault | None = None
        self._motions = 0
        self._still_s = 0.0  # how long the arm has not moved
        self._heard_s = 0.0  # when the client's last line came
        self._planned: tuple[float, Fault] | None = None

    # --- requests -------------------------------------------------------------------------------------------

    def hear(self) -> None:
        """Note that a line of the client arrived."""
        self._heard_s = self.time_s

    @property
    def silent_s(self) -> float:
        """How long no line of the client has come."""
        return self.time_s - self._heard_s

    def permit(self) -> None:
        """Unlock the arm. Raises RefusedError during a stop."""
        self._refuse_in_stop()
        self.locked = False

    def set_tool(self, tool: dict[str, object], mass_kg: float) -> None:
        """Set the load and the tool centre point. Raises RefusedError for a load beyond the rating."""
        if not 0.0 <= mass_kg <= self.model.payload_kg:
            raise RefusedError("load", f"a load of {mass_kg:g} kg is not within 0 to {self.model.payload_kg:g} kg")
        if self.motion is not None:
            raise RefusedError("moving", "the arm moves")
        self.tool = tool

    def move(self, goal: Array, speed: float, acceleration: float) -> int:
        """Start a motion and return its number. Raises RefusedError."""
        self._refuse_in_stop()
        if not self.ready:
            raise RefusedError("not_ready", "the arm is not ready to move")
        if self.locked:
            raise RefusedError("locked", "nobody has permitted motion")
        if self.motion is not None:
            raise RefusedError("moving", "the arm moves already")
        beyond = np.flatnonzero(np.abs(goal) > np.array(self.model.limits_rad))
        if len(beyond):
            raise RefusedError("limits", f"joint {beyond[0] + 1} would leave its range")
        fault = self.faults.check(self.device, "move")
        if fault is not None and fault.kind == "reject":
            raise RefusedError("failed", "the motion was rejected")
        if fault is not None and fault.kind in ("stall", "drop"):
            self.stream_fault = fault
        elif fault is not None:
            delay_s = float(fault.value) if isinstance(fault.value, (int, float)) else 0.15
            self._planned = (self.time_s + delay_s, fault)
        self._motions += 1
        braked = self._still_s * self.speed_up > BRAKE_IDLE_S
        wait_s = BRAKE_RELEASE_S / self.speed_up if braked else 0.0
        rated = min(self.model.speeds_rad_s)
        self.motion = _Motion(self._motions, self.q.copy(), goal, min(speed, rated), acceleration, wait_s)
        return self._motions

    def stop(self, end_code: str = "stopped", what: str = "the motion was stopped") -> None:
        """Decelerate the motion, if there is one."""
        if self.motion is not None and self.motion.stopping is None:
            self.motion.stopping = MotionEnd(self.motion.number, end_code, what)

    def lose_client(self) -> None:
        """The connection ended: stop, and lock until a person permits motion again."""
        self.locked = True
        self.stop("stopped", "the connection ended")

    # --- the pendant and the periphery ---------------------------------------------------------------------

    def stop_safely(self, safety: str) -> None:
        """A stop of the safety controller: brakes at once and locks the arm."""
        _LOG.warning("%s", safety)
        self.safety, self.locked = safety, True
        self.stop("safety", f"the arm is in {safety.replace('_', ' ')}")

    def release(self) -> None:
        """A person has removed the cause and acknowledged the stop; the arm stays locked."""
        self.safety = "normal"

    # --- cycle ------------------------------------------------------------------------------------------------

    def advance(self, dt_s: float) -> MotionEnd | None:
        """Advance by dt_s of real time; returns the motion that ended."""
        self.time_s += dt_s
        if dt_s > 0.1:  # this process was not scheduled: the client's lines wait unread, and are not late
            self._heard_s += dt_s - 0.1
        if self._planned is not None and self.time_s >= self._planned[0]:
            fault, self._planned = self._planned[1], None
            self.stop_safely(fault.kind if fault.kind in SAFETY else "fault")
        if self.motion is None:
            self._still_s += dt_s
            return None
        if self.silent_s > self.heartbeat_s and self.motion.stopping is None:
            self.locked = True
            self.stop("heartbeat", f"the arm was stopped: no line of its client for {self.heartbeat_s:g} s")
        return self._move(self.motion, dt_s)

    def _move(self, motion: _Motion, dt_s: float) -> MotionEnd | None:
        motion.waits_s -= dt_s
        if motion.waits_s > 0 and motion.stopping is None:
            return None
        self._still_s = 0.0
        self._feel_load()
        over = motion.advance(dt_s * self.speed_up * self.override, self._t1_limit(motion))
        self.q = motion.q
        if not over:
            return None
        self.motion = None
        return motion.stopping or MotionEnd(motion.number)

    def _feel_load(self) -> None:
        """Stop if the load is not the one that was set: the torque sensors take the difference for a collision."""
        mass_kg = self.tool["mass_kg"]
        assert isinstance(mass_kg, float)
        if self.true_load_kg is None or self.safety != "normal":
            return
        if abs(mass_kg - self.true_load_kg) > LOAD_TOLERANCE_KG:
            self.stop_safely("protective_stop")

    def _t1_limit(self, motion: _Motion) -> float:
        """The largest speed of the fastest joint, rad/s, at which the flange keeps to the limit of T1."""
        if self.mode != "T1":
            return math.inf
        J = kinematics.jacobian(kinematics.frames(self.model, self.q))
        direction = (motion.goal - motion.start) / max(motion.length, 1e-9)
        flange = float(np.linalg.norm(J[:3] @ direction))
        return T1_SPEED_M_S / max(flange * self.speed_up, 1e-9)

    def _refuse_in_stop(self) -> None:
        if self.safety != "normal":
            raise RefusedError("safety", f"the arm is in {self.safety.replace('_', ' ')}")

    def state(self, number: int) -> dict[str, object]:
        """The line of the stream."""
        T = kinematics.frames(self.model, self.q)[-1]
        joints = [float(v) for v in self.q]
        return {
            "is": "state", "n": number, "time_s": round(self.time_s, 6), "q": joints, "q_command": joints,
            "flange_xyz_m": [float(v) for v in T[:3, 3]], "flange_abc_rad": list(kinematics.to_abc(T[:3, :3])),
            "mode": self.mode, "safety": self.safety, "ready": self.ready, "locked": self.locked,
            "motion": self.motion.number if self.motion is not None else 0, "override": self.override,
        }  # fmt: skip
