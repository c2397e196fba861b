"""Emulates the client library's control script, recognised by its text: a command loop over registers."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable

import numpy as np

from simulators.ur_controller import kinematics
from simulators.ur_controller.controller import Controller
from simulators.ur_controller.kinematics import Array
from simulators.ur_controller.motion import Motion, MotionError, MoveJ, MoveL, Path, Servo, Speed, Stop

_LOG = logging.getLogger(__name__)

READY, DONE = 1, 2
JOG_STOP_M_S2 = 1.2
LEVER_M = 0.5  # of the arm, to convert accelerations of the tool to those of the joints
_RUNNING_BIT = 1 << 15
_NUMBERS = r"\[([^\]]*)\]"
_LEG = re.compile(rf"\b(movej|movel|movep)\s*\(\s*(p?){_NUMBERS}\s*,([^)]*)\)")
_OPTION = re.compile(r"\b([avr])\s*=\s*([-+0-9.eE]+)")


class StopProgram(Exception):  # noqa: N818 - not an error: the script returns
    """The program ends; the message says why."""


class ControlProgram:
    """The script's command loop: reads a command from the registers, executes it, reports ready and done."""

    def __init__(self, controller: Controller, text: str) -> None:
        self._c = controller
        self.name = "rtde_control"
        self._float = _offset(text, "reg_offset_float")
        self._int = _offset(text, "reg_offset_int")
        self._path = _path_of(text)
        self._executing = 0
        self._blocking = False  # the loop waits for the motion to end
        self._async = False  # a motion thread reports its progress
        self._writes = self._operations = 0
        self._watchdog_s = 0.0  # longest time between two writes of the command register; 0: no watchdog
        self._told: set[int] = set()  # commands that were logged as having no effect
        self._handlers = {**self._moves(), **self._questions(), **self._settings()}
        self._progress(-1)

    # --- registers ---------------------------------------------------------------------------------------

    def _in(self, index: int) -> float:
        return self._c.inputs.doubles[self._float + index]

    def _vector(self, index: int) -> Array:
        at = self._float + index
        return np.array(self._c.inputs.doubles[at : at + 6])

    def _in_int(self, index: int) -> int:
        return self._c.inputs.ints[self._int + index]

    def _out_int(self, index: int, value: int) -> None:
        self._c.outputs.ints[self._int + index] = value
        self._c.generation += 1

    def _out(self, values: Array | list[float]) -> None:
        for i, value in enumerate(values):
            self._c.outputs.doubles[self._float + i] = float(value)
        self._c.generation += 1

    def _progress(self, value: int) -> None:
        self._writes = (self._writes + 1) & 127
        if value == 0:
            self._operations = (self._operations + 1) & 127
        word = self._writes << 16 | self._operations << 24
        self._out_int(2, word | _RUNNING_BIT | value if value >= 0 else word)

    # --- loop --------------------------------------------------------------------------------------------

    def step(self) -> None:
        """Run one cycle. Raises StopProgram when the script ends."""
        written_s = self._c.int_written_s[self._int]
        if 0.0 < self._watchdog_s < self._c.time_s - written_s:
            raise StopProgram(f"watchdog: nothing written for {self._c.time_s - written_s:.3f} s")
        if self._async:
            self._watch_async()
        if self._blocking:
            if self._c.motion is not None:
                return
            self._blocking = False
            self._out_int(0, DONE)
        command = self._in_int(0)
        if command == 0:
            self._executing = 0
            self._out_int(0, READY) if self._c.outputs.ints[self._int] != READY else None
            return
        if command in _STREAMED:
            self._handle(command)
            return
        if command != self._executing:
            self._executing = command
            self._handle(command)
            if not self._blocking:
                self._out_int(0, DONE)

    def _watch_async(self) -> None:
        motion = self._c.motion
        if motion is None:
            self._async = False
            self._progress(-1)
        elif isinstance(motion, Path) and motion.waypoint != self._waypoint:
            self._waypoint = motion.waypoint
            self._progress(motion.waypoint)

    def _handle(self, command: int) -> None:
        fault = self._c.faults.check(self._c.device, "command")
        if fault is not None and fault.kind == "reject":
            raise StopProgram(f"command {command} rejected by the fault plan")
        handler = self._handlers.get(command)
        if handler is None:
            if command not in self._told:
                self._told.add(command)
                _LOG.warning("command %d is not simulated: %s", command, _NOT_SIMULATED.get(command, "unknown"))
            return
        try:
            handler()
        except MotionError as error:
            raise StopProgram(str(error)) from error

    def _moves(self) -> dict[int, Callable[[], None]]:
        """Commands that move or stop the arm."""
        return {
            1: lambda: self._move_joints(self._vector(0)),
            2: lambda: self._move_joints(self._solve(self._vector(0), self._c.target_q)),
            3: lambda: self._move_straight(kinematics.from_pose(self._vector(0))),
            4: lambda: self._move_straight(self._forward(self._vector(0), self._c.tcp_pose_m)),
            9: lambda: self._speed(tool=False),
            10: lambda: self._speed(tool=True),
            11: lambda: self._servo(self._vector(0)),
            12: self._servo_along,
            15: self._stop_now,
            16: self._stop_now,
            24: lambda: self._servo(self._solve(self._vector(0), self._c.target_q)),
            31: self._stop_protectively,
            33: self._stop_now,
            34: self._stop_now,
            41: self._jog,
            42: lambda: self._decelerate(JOG_STOP_M_S2 / LEVER_M),
            45: self._follow_path,
            51: self._move_until_contact,
        }

    def _questions(self) -> dict[int, Callable[[], None]]:
        """Commands whose answer is in the output registers."""
        return {
            25: lambda: self._answer(False),  # there is never any contact
            26: lambda: self._out([self._c.step_s]),
            27: lambda: self._out(self._c.joints_ago(self._in_int(1))),
            28: lambda: self._out(self._c.target_tcp_pose),
            30: lambda: self._out(self._solve(self._vector(0), self._vector(6))),
            36: lambda: self._answer(self._c.inverse(self._vector(0), self._c.target_q) is not None),
            37: lambda: self._answer(self._c.within_limits(self._vector(0))),
            38: lambda: self._no_numbers(6),
            39: lambda: self._out(
                kinematics.to_pose(kinematics.from_pose(self._vector(0)) @ kinematics.from_pose(self._vector(6)))
            ),
            40: lambda: self._out(self._c.tcp_pose_m),
            43: lambda: self._out(self._c.tcp_pose),
            44: lambda: self._out(kinematics.to_pose(self._forward(self._vector(0), self._vector(6)))),
            46: lambda: self._out(self._solve(self._vector(0), self._c.target_q)),
            47: lambda: self._answer(self._c.steady),
            54: lambda: self._answer(False),
            58: lambda: self._out(kinematics.to_pose(self._c.T_base_flange)),
            60: lambda: self._answer(self._c.inverse(self._vector(0), self._c.target_q) is not None),
            61: lambda: self._answer(self._c.inverse(self._vector(0), self._vector(6)) is not None),
            63: lambda: self._answer(False),
            64: lambda: self._answer(False),
            67: lambda: self._no_numbers(36),
            68: lambda: self._no_numbers(6),
            69: lambda: self._out(self._c.target_qdd),
            70: lambda: self._matrix(self._c.jacobian(self._c.actual_q)),
            71: lambda: self._matrix(self._c.jacobian_rate()),
        }

    def _settings(self) -> dict[int, Callable[[], None]]:
        """Commands that set something, or do nothing here, and the end of the script."""
        return {
            8: _nothing,  # the force is always zero
            17: self._payload,
            18: _nothing,  # nobody pushes the arm: it stays in place
            19: _nothing,
            29: lambda: self._c.set_tcp(self._vector(0)),
            35: self._watch,
            52: _nothing,
            53: _nothing,
            62: _nothing,
            65: self._target_payload,
            255: self._end,
        }

    def _no_numbers(self, count: int) -> None:
        command = self._in_int(0)
        if command not in self._told:
            self._told.add(command)
            _LOG.warning("command %d is not simulated: %s", command, _NOT_SIMULATED[command])
        self._matrix(np.zeros((count, 1)))

    def _matrix(self, numbers: Array) -> None:
        """Write a matrix column by column, into the lower registers and then the last twelve (since 5.23)."""
        for register, value in zip(_NEW_REGISTERS, numbers.T.ravel(), strict=False):
            self._c.outputs.doubles[register] = float(value)
        self._c.generation += 1

    # --- commands ----------------------------------------------------------------------------------------

    def _answer(self, yes: bool) -> None:
        self._out_int(1, int(yes))

    def _end(self) -> None:
        raise StopProgram("asked for by the client")

    def _forward(self, q: Array, tcp_pose: Array) -> Array:
        return kinematics.forward(self._c.model, q) @ kinematics.from_pose(tcp_pose)

    def _solve(self, pose: Array, near: Array) -> Array:
        q = self._c.inverse(pose, near)
        if q is None:
            raise MotionError("inverse kinematics finds no solution")  # this ends a real script too
        return q

    def _move_joints(self, goal: Array) -> None:
        if not self._c.within_limits(goal):
            raise MotionError("joint target beyond its limits")
        self._begin(MoveJ(self._c.target_q, goal, self._in(6), self._in(7)))

    def _move_straight(self, T_base_tcp: Array) -> None:
        tool = kinematics.from_pose(self._c.tcp_pose_m)
        self._begin(
            MoveL(self._c.model, self._c.target_q, T_base_tcp, tool, speed=self._in(6), acceleration=self._in(7))
        )

    def _follow_path(self) -> None:
        c = self._c
        tool = kinematics.from_pose(c.tcp_pose_m)
        legs: list[Callable[[Array], Motion]] = []
        for straight, pose, target, speed, acceleration in self._path:
            legs.append(_leg(c, tool, straight=straight, pose=pose, target=target, v=speed, a=acceleration))
        self._begin(Path(c.target_q, legs))

    def _begin(self, motion: Motion) -> None:
        if not self._c.may_move or not self._c.start(motion):
            raise StopProgram("the controller does not allow motion")
        self._async = self._in_int(1) == 1
        self._blocking = not self._async
        self._waypoint = 0
        if self._async:
            self._progress(0)

    def _speed(self, *, tool: bool) -> None:
        self._keep_speed(self._vector(0), self._in(6), tool=tool)

    def _keep_speed(self, target: Array, acceleration: float, *, tool: bool) -> None:
        c = self._c
        if isinstance(c.motion, Speed):
            c.motion.target = target
            return
        frame = kinematics.from_pose(c.tcp_pose_m)
        motion = Speed(
            c.model, c.target_q, c.planned_qd, T_flange_tcp=frame, target=target, acceleration=acceleration, tool=tool
        )
        if not c.may_move or not c.start(motion):
            raise StopProgram("the controller does not allow motion")

    def _jog(self) -> None:
        """Jog along the axes of the base, the tool or a given frame (registers 6 to 13)."""
        feature = round(self._in(6))
        pose = self._c.tcp_pose if feature == 1 else self._vector(8) if feature == 2 else np.zeros(6)
        R = kinematics.from_pose(pose)[:3, :3]
        speed = self._vector(0)
        self._keep_speed(np.concatenate([R @ speed[:3], R @ speed[3:]]), self._in(7), tool=True)

    def _move_until_contact(self) -> None:
        """Move until contact, which never comes: the arm goes to its limit and stops protectively."""
        self._keep_speed(self._vector(0), self._in(12), tool=True)
        self._blocking = True

    def _servo_along(self) -> None:
        """servoC along a straight line, without reporting its end."""
        c = self._c
        goal, tool = kinematics.from_pose(self._vector(0)), kinematics.from_pose(c.tcp_pose_m)
        line = MoveL(c.model, c.target_q, goal, tool, speed=self._in(6), acceleration=self._in(7))
        if not c.may_move or not c.start(line):
            raise StopProgram("the controller does not allow motion")

    def _servo(self, goal: Array) -> None:
        c = self._c
        if isinstance(c.motion, Servo):
            c.motion.target = goal
        elif not c.may_move or not c.start(Servo(c.target_q, c.planned_qd, goal, self._in(9))):
            raise StopProgram("the controller does not allow motion")

    def _stop_now(self) -> None:
        # stopL's deceleration is that of the tool, in m/s².
        self._decelerate(self._in(0) / (LEVER_M if self._executing == 33 else 1.0))

    def _decelerate(self, deceleration: float) -> None:
        if self._c.motion is None:
            return
        self._c.replace(Stop(self._c.target_q, self._c.planned_qd, deceleration))
        self._blocking = self._in_int(1) != 1 or self._executing not in (33, 34)

    def _stop_protectively(self) -> None:
        self._c.protective_stop("asked for by the program")
        raise StopProgram("protective stop")

    def _watch(self) -> None:
        frequency_hz = self._in(0)
        self._watchdog_s = max(1.0 / frequency_hz, self._c.patience_s) if frequency_hz > 0 else 0.0

    def _payload(self) -> None:
        cog = [self._in(1), self._in(2), self._in(3)]
        if not self._c.set_payload(self._in(0), cog if any(cog) else self._c.payload_cog_m):
            raise StopProgram("payload beyond the rating")

    def _target_payload(self) -> None:
        self._payload()
        self._c.payload_inertia = [self._in(i) for i in range(4, 10)]


# Executed every cycle while the command stays in the register.
_STREAMED = frozenset((6, 9, 10, 11, 24, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71))
# Reported as done without effect; queries are answered with zeros.
_NOT_SIMULATED = {
    6: "force mode",
    7: "the end of force mode",
    20: "damping of the force mode",
    21: "gain of the force mode",
    38: "joint torques",
    56: "a force sensor's input",
    57: "an external force sensor",
    59: "the direction of gravity",
    66: "direct torque",
    67: "the mass matrix",
    68: "Coriolis and centrifugal torques",
}
_NEW_REGISTERS = (*range(24), *range(36, 48))  # for matrices, column by column


def _nothing() -> None:
    """Do nothing; done at once."""


def _offset(text: str, name: str) -> int:
    # The client writes the number on the next line, after a comment.
    match = re.search(rf"{name}\s*=\s*(?:#[^\n]*\n\s*)?(\d+)", text)
    return int(match.group(1)) if match else 0


def _path_of(text: str) -> list[tuple[bool, bool, Array, float, float]]:
    """Parse the way points in the script: whether straight, whether a pose, target, speed, acceleration."""
    match = re.search(r"def exec_move_path\(\):(.*?)\n\s*end\b", text, re.DOTALL)
    path: list[tuple[bool, bool, Array, float, float]] = []
    for verb, pose, numbers, rest in _LEG.findall(match.group(1) if match else ""):
        options = {key: float(value) for key, value in _OPTION.findall(rest)}
        target = np.array([float(n) for n in numbers.split(",")])
        path.append((verb != "movej", pose == "p", target, options.get("v", 0.25), options.get("a", 1.2)))
    return path


def _leg(
    c: Controller, tool: Array, *, straight: bool, pose: bool, target: Array, v: float, a: float
) -> Callable[[Array], Motion]:
    def make(q: Array) -> Motion:
        if straight:
            T = kinematics.from_pose(target) if pose else kinematics.forward(c.model, target) @ tool
            return MoveL(c.model, q, T, tool, speed=v, acceleration=a)
        goal = c.inverse(target, q) if pose else target
        if goal is None:
            raise MotionError("a way point is out of reach")
        return MoveJ(q, goal, v, a)

    return make
