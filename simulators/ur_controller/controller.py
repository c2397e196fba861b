"""The controller's state (modes, safety, joints, registers, inputs and outputs), advanced cycle by cycle."""

from __future__ import annotations

import logging
import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from simulators.faults import Fault, FaultPlan
from simulators.ur_controller import fields, kinematics
from simulators.ur_controller.kinematics import Array, Model
from simulators.ur_controller.modes import (
    FREE,
    HOLDING,
    SAFETY_BITS,
    WITHOUT_POWER,
    RobotMode,
    Runtime,
    SafetyMode,
    StartUp,
)
from simulators.ur_controller.motion import Hand, Motion, MotionError

_LOG = logging.getLogger(__name__)

PROTECTIVE_UNLOCK_S = 5.0
LONGEST_CYCLE_S = 0.02
HISTORY_CYCLES = 4096  # of joint history that programs may query
RING_FREQUENCY_HZ, RING_DECAY_S, RING_AMPLITUDE_S2 = 12.0, 0.06, 4e-5  # the arm oscillates slightly when it stops


@dataclass
class Registers:
    """Integer and double registers of one direction."""

    ints: list[int] = field(default_factory=lambda: [0] * 48)
    doubles: list[float] = field(default_factory=lambda: [0.0] * 48)


class Controller:
    """One controller with its arm.

    Time is in seconds since start-up; `speed_up` shortens motions and waits.
    """

    def __init__(
        self,
        model: Model,
        version: fields.Version,
        *,
        joints: Array,
        serial: str,
        faults: FaultPlan,
        device: str,
        speed_up: float = 1.0,
        patience_s: float = 0.0,
    ) -> None:
        self.model, self.version, self.serial, self.speed_up = model, version, serial, speed_up
        self.patience_s = patience_s  # the watchdog of a program waits at least so long
        self.faults, self.device = faults, device
        self.step_s = 0.002 if version[0] >= 5 else 0.008
        self.time_s = 0.0
        self.robot_mode = RobotMode.RUNNING
        self._start_up = StartUp(speed_up)
        self.safety = SafetyMode.NORMAL
        self.runtime = Runtime.STOPPED
        self.program_name = ""
        self.inputs, self.outputs = Registers(), Registers()
        self.int_written_s = [0.0] * 48  # time at which a client last wrote each integer input
        self.payload_kg, self.payload_cog_m, self.payload_inertia = 0.0, [0.0] * 3, [0.0] * 6
        self.tcp_pose_m = np.zeros(6)
        self.speed_fraction = 1.0
        self.local = False  # local control: no remote commands
        self.digital_outputs = 0
        self.analog_outputs = [0.0, 0.0]
        self.operational_since_s = 0.0
        self.target_q, self.target_qd, self.target_qdd = joints.copy(), np.zeros(6), np.zeros(6)
        self.actual_q, self.actual_qd = joints.copy(), np.zeros(6)
        self.T_base_flange = kinematics.forward(model, joints)
        self.tcp_pose, self.target_tcp_pose = np.zeros(6), np.zeros(6)
        self.tcp_speed = np.zeros(6)
        self._history: deque[Array] = deque([joints.copy()], maxlen=HISTORY_CYCLES)
        self._cycles = 0
        self.generation = 0  # increases whenever anything but the clock changes
        self.motion: Motion | None = None
        self._stopped_at_s = -math.inf
        self._button_released_s = math.inf
        self._pending_fault: tuple[float, Fault] | None = None
        self.stream_fault: Fault | None = None  # for the server: a motion that also breaks the stream
        self._ring: tuple[float, Array] | None = None
        self._hand: Hand | None = None  # somebody pushes the arm
        self._pushed = np.zeros(6)  # from the path of the motion under way
        self._pushed_qd = np.zeros(6)  # how fast the hand turns the joints
        self._place_tool()

    # --- cycle -------------------------------------------------------------------------------------------

    def advance(self, dt_s: float) -> None:
        """Advance by dt_s of real time: a cycle, or several in which nothing changes."""
        self.time_s += dt_s
        if (lost_s := dt_s - LONGEST_CYCLE_S) > 0:
            # A real controller keeps its cycle time. If this process was not scheduled, clients' writes are still
            # unread, but must not count as late.
            self.int_written_s = [at_s + lost_s for at_s in self.int_written_s]
        if self._pending_fault is not None and self.time_s >= self._pending_fault[0]:
            fault, self._pending_fault = self._pending_fault[1], None
            self.emergency_stop(fault) if fault.kind == "emergency_stop" else self.protective_stop(fault.kind)
        if self._start_up.under_way:
            self._enter(self._start_up.advance(self.robot_mode, self.time_s))
        if self.time_s >= self._button_released_s:
            self._release()
        if self._hand is not None:
            self._give_way(self._hand, dt_s)
        if self.motion is not None:
            self._move(dt_s)
        elif self._ring is not None:
            self._swing()
        cycles, self._cycles = self._cycles, int(self.time_s / self.step_s)
        self._history.extend([self.actual_q] * min(self._cycles - cycles, HISTORY_CYCLES))

    @property
    def busy(self) -> bool:
        """Return whether anything but the clock changes from cycle to cycle, or will at a planned time."""
        changing = any(v is not None for v in (self.motion, self._ring, self._pending_fault, self._hand))
        return changing or self._start_up.under_way or self._button_released_s < math.inf

    def _move(self, dt_s: float) -> None:
        assert self.motion is not None
        scale = self.speed_up * self.speed_fraction
        try:
            self.motion.advance(dt_s * scale)
        except MotionError as error:
            self.protective_stop(str(error))
            return
        if self.motion.done and np.any(self.target_qdd):
            self._ring = (self.time_s, -RING_AMPLITUDE_S2 * self.target_qdd)
        if not self.within_limits(self.motion.q + self._pushed):
            self.protective_stop("a joint reached its limit")
            return
        self.target_q = self.motion.q + self._pushed
        self.target_qd, self.target_qdd = self.motion.qd * scale, self.motion.qdd * scale
        self.actual_q, self.actual_qd = self.target_q, self.target_qd + self._pushed_qd
        if self.motion.done:
            self.motion = None
        self._place_tool()

    def _give_way(self, hand: Hand, dt_s: float) -> None:
        """Let the hand turn the joints for dt_s."""
        step = hand.advance(dt_s)
        self._hand = None if hand.done else hand
        if hand.done and self.robot_mode is RobotMode.BACKDRIVE:
            self._enter(RobotMode.IDLE)
        self._pushed, self.target_q = self._pushed + step, self.target_q + step
        self._pushed_qd = np.zeros(6) if hand.done else step / max(dt_s, 1e-6)
        if self.motion is None and self._ring is None:
            self.actual_q, self.actual_qd = self.target_q, self._pushed_qd
            self._place_tool()

    def _swing(self) -> None:
        assert self._ring is not None
        start_s, amplitude = self._ring
        t = (self.time_s - start_s) * self.speed_up
        if t > 12 * RING_DECAY_S:
            self._ring = None
            self.actual_q, self.actual_qd = self.target_q, np.zeros(6)
        else:
            w = 2 * math.pi * RING_FREQUENCY_HZ
            envelope = math.exp(-t / RING_DECAY_S)
            self.actual_q = self.target_q + amplitude * (envelope * math.sin(w * t))
            rate = envelope * (w * math.cos(w * t) - math.sin(w * t) / RING_DECAY_S) * self.speed_up
            self.actual_qd = amplitude * rate
        self._place_tool()

    def _place_tool(self) -> None:
        chain = kinematics.frames(self.model, self.actual_q)
        self.T_base_flange = chain[6]
        T_base_tcp = chain[6] @ kinematics.from_pose(self.tcp_pose_m)
        self.tcp_pose = kinematics.to_pose(T_base_tcp)
        self.target_tcp_pose = self.tcp_pose
        moving = bool(np.any(self.actual_qd))
        self.tcp_speed = kinematics.jacobian(chain, T_base_tcp[:3, 3]) @ self.actual_qd if moving else np.zeros(6)
        self.generation += 1

    # --- what programs and clients do ------------------------------------------------------------------

    @property
    def may_move(self) -> bool:
        """Return whether the brakes are released and no stop is active."""
        return self.robot_mode is RobotMode.RUNNING and self.safety in FREE

    @property
    def planned_qd(self) -> Array:
        """Joint velocities (6,) of the motion, before the speed slider and `speed_up`."""
        return self.motion.qd if self.motion is not None else np.zeros(6)

    @property
    def steady(self) -> bool:
        """is_steady(): whether the target stands still; the arm's oscillation is not considered."""
        return self.motion is None

    def start(self, motion: Motion) -> bool:
        """Begin a motion, replacing the current one; False if a fault plan refuses it."""
        fault = self.faults.check(self.device, "move")
        if fault is not None and fault.kind == "reject":
            return False
        if fault is not None and fault.kind in ("stall", "drop"):
            self.stream_fault = fault
        elif fault is not None:
            delay_s = float(fault.value) if isinstance(fault.value, (int, float)) else 0.15
            self._pending_fault = (self.time_s + delay_s, fault)
        self.replace(motion)
        return True

    def replace(self, motion: Motion) -> None:
        """Change the current motion (stop, new speed target); fault plans do not count this as a motion."""
        self.motion = motion
        self._ring = None
        self._pushed = np.zeros(6)  # it begins where the arm is

    def push(self, by_rad: Array, seconds: float) -> None:
        """Turn the joints (6,) by hand, evenly over some time; the arm gives way."""
        self._hand = Hand(by_rad, seconds)

    def backdrive(self, by_rad: Array, seconds: float) -> bool:
        """Turn the joints (6,) against the brakes, which is possible before they are released."""
        if self.robot_mode is not RobotMode.IDLE:
            return False
        self._enter(RobotMode.BACKDRIVE)
        self.push(by_rad, seconds)
        return True

    def set_speed(self, fraction: float) -> None:
        """Move the speed slider."""
        self.speed_fraction = min(1.0, max(0.0, fraction))
        self.generation += 1

    def halt(self) -> None:
        """Stop within this cycle."""
        self.motion = None
        if np.any(self.target_qd):
            self._ring = (self.time_s, -RING_AMPLITUDE_S2 * 5 * np.sign(self.target_qd))
        self.target_qd, self.target_qdd = np.zeros(6), np.zeros(6)
        self.actual_qd = np.zeros(6)
        self._place_tool()

    def set_tcp(self, pose: Array) -> None:
        """Set the tool centre point, as a pose (6,) in the flange frame."""
        self.tcp_pose_m = pose.copy()
        self._place_tool()

    def set_payload(self, mass_kg: float, cog_m: list[float]) -> bool:
        """Set the mass and the centre of gravity; False if they exceed the model's rating."""
        if not 0.0 <= mass_kg <= self.model.payload_kg:
            return False
        self.payload_kg, self.payload_cog_m = mass_kg, cog_m
        self.generation += 1
        return True

    def within_limits(self, q: Array) -> bool:
        """Return whether all joints are within ±360°."""
        return bool(np.all(np.isfinite(q)) and np.max(np.abs(q)) <= kinematics.JOINT_LIMIT_RAD + 1e-9)

    def joints_ago(self, cycles: int) -> Array:
        """Measured joints (6,) that many cycles ago, or the oldest known ones."""
        return self._history[-1 - min(max(cycles, 0), len(self._history) - 1)]

    def jacobian(self, q: Array) -> Array:
        """Jacobian (6, 6) of the tool centre point in the base frame at joints q (6,)."""
        chain = kinematics.frames(self.model, q)
        return kinematics.jacobian(chain, (chain[6] @ kinematics.from_pose(self.tcp_pose_m))[:3, 3])

    def jacobian_rate(self) -> Array:
        """Time derivative (6, 6) of the Jacobian at the current joint speeds, by a central difference."""
        step = 1e-5
        ahead, behind = self.actual_q + step * self.actual_qd, self.actual_q - step * self.actual_qd
        return (self.jacobian(ahead) - self.jacobian(behind)) / (2 * step)

    def inverse(self, pose: Array, near: Array) -> Array | None:
        """Joints (6,) that bring the tool centre point to a pose, closest to `near`; None if unreachable."""
        T = kinematics.from_pose(pose) @ kinematics.rigid_inverse(kinematics.from_pose(self.tcp_pose_m))
        return kinematics.inverse(self.model, T, near)

    # --- safety --------------------------------------------------------------------------------------------

    def protective_stop(self, why: str) -> None:
        """Stop at once and end the program; a person must unlock the arm."""
        _LOG.warning("protective stop: %s", why)
        self._stop(SafetyMode.PROTECTIVE_STOP)

    def emergency_stop(self, fault: Fault | None = None) -> None:
        """Stop and cut the power; the button is released after the fault's value in seconds (default 2)."""
        hold_s = float(fault.value) if fault is not None and isinstance(fault.value, (int, float)) else 2.0
        _LOG.warning("emergency stop")
        self._stop(SafetyMode.ROBOT_EMERGENCY_STOP)
        self._button_released_s = self.time_s + hold_s / self.speed_up

    def _release(self) -> None:
        """Release the emergency stop: safety is normal again, and the arm stays without power."""
        self._button_released_s = math.inf
        self.safety = SafetyMode.NORMAL
        self.generation += 1

    def turn_safety(self, mode: SafetyMode) -> None:
        """Enter a safety mode: by a door, a three-position switch, a key, or what the safety system found.

        A door or switch holds the program, which stays paused when it is over. All other stops end it.
        """
        self._button_released_s = math.inf
        if mode in FREE:
            self.safety = mode
            self.generation += 1
        elif mode in HOLDING:
            held = Runtime.PAUSED if self.runtime is Runtime.PLAYING else self.runtime
            self._stop(mode)
            self.runtime = held
        else:
            self._stop(mode)

    def _stop(self, mode: SafetyMode) -> None:
        self.halt()
        self.safety, self.runtime = mode, Runtime.STOPPED
        self._stopped_at_s = self.time_s
        if mode in WITHOUT_POWER:
            self._start_up.cancel()
            self._enter(RobotMode.POWER_OFF)
        self.generation += 1

    def _enter(self, mode: RobotMode) -> None:
        if mode is not self.robot_mode:
            self.robot_mode = mode
            self.generation += 1

    def unlock_protective_stop(self) -> bool:
        """Release a protective stop, possible 5 s after it; returns whether it was released."""
        if self.safety is not SafetyMode.PROTECTIVE_STOP:
            return True
        if self.time_s - self._stopped_at_s < PROTECTIVE_UNLOCK_S / self.speed_up:
            return False
        self.safety = SafetyMode.NORMAL
        self.generation += 1
        return True

    def power_on(self) -> None:
        """Switch the power on without releasing the brakes; in vain while a stop cuts it."""
        if self.safety not in WITHOUT_POWER:
            self._enter(self._start_up.begin(self.robot_mode, RobotMode.IDLE, self.time_s))

    def power_off(self) -> None:
        """Apply the brakes, switch the power off and end the program."""
        self.halt()
        self._start_up.cancel()
        self._enter(RobotMode.POWER_OFF)
        self.runtime = Runtime.STOPPED
        self.generation += 1

    def brake_release(self) -> None:
        """Release the brakes, switching the power on if needed; the mode becomes RUNNING."""
        if self.safety not in WITHOUT_POWER:
            self._enter(self._start_up.begin(self.robot_mode, RobotMode.RUNNING, self.time_s))

    # --- RTDE fields -----------------------------------------------------------------------------------------

    def apply(self, written: dict[str, tuple[float, ...]]) -> None:
        """Apply the fields of a client's data package."""
        for name, value in written.items():
            if name.startswith("input_int_register_"):
                self.inputs.ints[int(name[19:])] = int(value[0])
                self.int_written_s[int(name[19:])] = self.time_s
            elif name.startswith("input_double_register_"):
                self.inputs.doubles[int(name[22:])] = value[0]
        if written.get("speed_slider_mask", (0,))[0]:
            self.set_speed(written.get("speed_slider_fraction", (1.0,))[0])
        for group, shift, width in (("standard", 0, 8), ("configurable", 8, 8), ("tool", 16, 2)):
            mask = int(written.get(f"{group}_digital_output_mask", (0,))[0]) & ((1 << width) - 1)
            bits = int(written.get(f"{group}_digital_output", (0,))[0])
            self.digital_outputs = (self.digital_outputs & ~(mask << shift)) | ((bits & mask) << shift)
        analog = int(written.get("standard_analog_output_mask", (0,))[0])
        for i in range(2):
            if analog >> i & 1:
                self.analog_outputs[i] = written.get(f"standard_analog_output_{i}", (0.0,))[0]
        self.generation += 1

    def values(self) -> dict[str, tuple[float, ...]]:
        """The current values of all fields that are not constantly zero, without the registers."""
        powered = self.robot_mode in (RobotMode.IDLE, RobotMode.BACKDRIVE, RobotMode.RUNNING)
        joint_mode = 253 if self.robot_mode is RobotMode.RUNNING else 255 if powered else 239
        return {
            "target_q": tuple(self.target_q),
            "target_qd": tuple(self.target_qd),
            "target_qdd": tuple(self.target_qdd),
            "actual_q": tuple(self.actual_q),
            "actual_qd": tuple(self.actual_qd),
            "actual_TCP_pose": tuple(self.tcp_pose),
            "target_TCP_pose": tuple(self.target_tcp_pose),
            "actual_TCP_speed": tuple(self.tcp_speed),
            "target_TCP_speed": tuple(self.tcp_speed),
            "actual_digital_output_bits": (self.digital_outputs,),
            "joint_temperatures": (28.0,) * 6,
            "robot_mode": (int(self.robot_mode),),
            "joint_mode": (joint_mode,) * 6,
            "safety_mode": (int(self.safety),),
            "safety_status": (int(self.safety),),
            "actual_tool_accelerometer": (0.0, 0.0, 9.81),
            "speed_scaling": (self.speed_fraction,),
            "target_speed_fraction": (self.speed_fraction,),
            "actual_main_voltage": (48.0,),
            "actual_robot_voltage": (48.0 if powered else 0.0,),
            "actual_joint_voltage": (48.0 if powered else 0.0,) * 6,
            "standard_analog_output0": (self.analog_outputs[0],),
            "standard_analog_output1": (self.analog_outputs[1],),
            "runtime_state": (int(self.runtime),),
            "robot_status_bits": (int(powered) | int(self.runtime is Runtime.PLAYING) << 1,),
            "safety_status_bits": (SAFETY_BITS[self.safety],),
            "payload": (self.payload_kg,),
            "payload_cog": tuple(self.payload_cog_m),
            "payload_inertia": tuple(self.payload_inertia),
            "tcp_offset": tuple(self.tcp_pose_m),
        }
