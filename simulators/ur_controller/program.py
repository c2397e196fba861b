"""Programs that arrive on the script port: the client library's control loop is recognised and emulated."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable

import numpy as np

from simulators.ur_controller import kinematics
from simulators.ur_controller.controller import Controller, Runtime
from simulators.ur_controller.kinematics import Array
from simulators.ur_controller.motion import Motion, MotionError, MoveJ, MoveL, Path, Servo, Speed, Stop

_LOG = logging.getLogger(__name__)

READY, DONE = 1, 2
_RUNNING_BIT = 1 << 15
_NUMBERS = r"\[([^\]]*)\]"
_LEG = re.compile(rf"\b(movej|movel|movep)\s*\(\s*(p?){_NUMBERS}\s*,([^)]*)\)")
_WRITE = re.compile(r"\bwrite_output_integer_register\(\s*(\d+)\s*(?:\+\s*(\d+)\s*)?,\s*(-?\d+)\s*\)")
_OPTION = re.compile(r"\b([avr])\s*=\s*([-+0-9.eE]+)")


class ScriptReader:
    """Cuts the text that arrives on the script port into programs: an `end` in column 0 closes one."""

    def __init__(self) -> None:
        self._lines: list[str] = []
        self._rest = ""

    def feed(self, data: bytes) -> list[str]:
        """Add bytes; returns the programs that are complete."""
        programs: list[str] = []
        *lines, self._rest = (self._rest + data.decode("utf-8", "replace")).split("\n")
        for line in lines:
            if not self._lines and not line.startswith(("def ", "sec ")):
                if line.strip():
                    programs.append(line)
                continue
            self._lines.append(line)
            if line.rstrip() == "end":
                programs.append("\n".join(self._lines))
                self._lines.clear()
        return programs


class StopProgram(Exception):  # noqa: N818 - it is no error: the script returns
    """The program ends."""


class ControlProgram:
    """The command loop of the control script: reads a command from registers, acts, reports ready and done."""

    def __init__(self, controller: Controller, text: str) -> None:
        self._c = controller
        self.name = "rtde_control"
        self._float = _offset(text, "reg_offset_float")
        self._int = _offset(text, "reg_offset_int")
        self._path = _path_of(text)
        self._executing = 0
        self._blocking = False  # the loop waits for the motion
        self._async = False  # a motion thread reports its progress
        self._writes = self._operations = 0
        self._watchdog_s = 0.0  # longest time between two writes of the command register; 0: not watched
        self._handlers = self._table()
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
        """One cycle. Raises StopProgram when the script ends."""
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
            # Forces, contact, freedrive and dynamics are taken as done without effect.
            _LOG.log(logging.DEBUG if command in _UNMODELLED else logging.WARNING, "command %d: no effect", command)
            return
        try:
            handler()
        except MotionError as error:
            raise StopProgram(str(error)) from error

    def _table(self) -> dict[int, Callable[[], None]]:
        return {
            1: lambda: self._move_joints(self._vector(0)),
            2: lambda: self._move_joints(self._solve(self._vector(0), self._c.target_q)),
            3: lambda: self._move_straight(kinematics.from_pose(self._vector(0))),
            4: lambda: self._move_straight(self._forward(self._vector(0), self._c.tcp_pose_m)),
            9: lambda: self._speed(tool=False),
            10: lambda: self._speed(tool=True),
            11: lambda: self._servo(self._vector(0)),
            15: self._stop_now,
            16: self._stop_now,
            17: self._payload,
            24: lambda: self._servo(self._solve(self._vector(0), self._c.target_q)),
            26: lambda: self._out([self._c.step_s]),
            27: lambda: self._out(self._c.actual_q),
            28: lambda: self._out(self._c.target_tcp_pose),
            29: lambda: self._c.set_tcp(self._vector(0)),
            30: lambda: self._out(self._solve(self._vector(0), self._vector(6))),
            31: lambda: self._c.protective_stop("asked for by the program"),
            33: self._stop_now,
            34: self._stop_now,
            35: self._watch,
            36: lambda: self._answer(self._c.inverse(self._vector(0), self._c.target_q) is not None),
            37: lambda: self._answer(self._c.within_limits(self._vector(0))),
            38: lambda: self._out([0.0] * 6),
            39: lambda: self._out(
                kinematics.to_pose(kinematics.from_pose(self._vector(0)) @ kinematics.from_pose(self._vector(6)))
            ),
            40: lambda: self._out(self._c.tcp_pose_m),
            41: lambda: self._speed(tool=True),
            42: self._stop_now,
            43: lambda: self._out(self._c.tcp_pose),
            44: lambda: self._out(kinematics.to_pose(self._forward(self._vector(0), self._vector(6)))),
            45: self._follow_path,
            46: lambda: self._out(self._solve(self._vector(0), self._c.target_q)),
            47: lambda: self._answer(self._c.steady),
            54: lambda: self._answer(False),
            58: lambda: self._out(kinematics.to_pose(self._c.T_base_flange)),
            60: lambda: self._answer(self._c.inverse(self._vector(0), self._c.target_q) is not None),
            61: lambda: self._answer(self._c.inverse(self._vector(0), self._vector(6)) is not None),
            65: self._payload,
            255: self._end,
        }

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
            raise MotionError("inverse kinematics finds no solution")  # a real script dies of it too
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
        c = self._c
        target = self._vector(0)
        if isinstance(c.motion, Speed):
            c.motion.target = target
            return
        acceleration = self._in(7 if self._in_int(0) == 41 else 6)
        frame = kinematics.from_pose(c.tcp_pose_m)
        motion = Speed(
            c.model, c.target_q, c.planned_qd, T_flange_tcp=frame, target=target, acceleration=acceleration, tool=tool
        )
        if not c.may_move or not c.start(motion):
            raise StopProgram("the controller does not allow motion")

    def _servo(self, goal: Array) -> None:
        c = self._c
        if isinstance(c.motion, Servo):
            c.motion.target = goal
        elif not c.may_move or not c.start(Servo(c.target_q, c.planned_qd, goal, self._in(9))):
            raise StopProgram("the controller does not allow motion")

    def _stop_now(self) -> None:
        if self._c.motion is None:
            return
        deceleration = self._in(0)
        if self._executing == 33:  # stopL's rate is the tool's, in m/s²; taken over the arm's usual lever of 0.5 m
            deceleration /= 0.5
        self._c.replace(Stop(self._c.target_q, self._c.planned_qd, deceleration))
        self._blocking = self._in_int(1) != 1 or self._executing not in (33, 34)

    def _watch(self) -> None:
        frequency_hz = self._in(0)
        self._watchdog_s = 1.0 / frequency_hz if frequency_hz > 0 else 0.0

    def _payload(self) -> None:
        cog = [self._in(1), self._in(2), self._in(3)]
        if not self._c.set_payload(self._in(0), cog if any(cog) else self._c.payload_cog_m):
            raise StopProgram("payload beyond the rating")


# Done every cycle for as long as the command stays in the register.
_STREAMED = frozenset((6, 9, 10, 11, 24, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71))
_UNMODELLED = frozenset((6, 7, 8, 12, 18, 19, 20, 21, 25, 51, 52, 53, 56, 57, 59, 62, 63, 64, 66, 67, 68, 69, 70, 71))


class OtherProgram:
    """Any other script: it is not interpreted but for the integers that it writes, one a cycle, and then ends."""

    def __init__(self, controller: Controller, text: str) -> None:
        match = re.match(r"(?:def|sec)\s+(\w+)", text)
        self.name = match.group(1) if match else "unnamed"
        self._outputs = controller.outputs
        self._writes = [(int(at) + int(more or 0), int(value)) for at, more, value in _WRITE.findall(text)]

    def step(self) -> None:
        """See ControlProgram."""
        if not self._writes:
            raise StopProgram("at its end; the rest of it is not modelled")
        at, value = self._writes.pop(0)
        self._outputs.ints[at] = value


class PendantProgram:
    """A program file that was loaded and started by the dashboard: it runs until it is stopped."""

    def __init__(self, name: str) -> None:
        self.name = name

    def step(self) -> None:
        """See ControlProgram."""


class Interpreter:
    """The one program that runs; `loaded` names the program file that the pendant has open."""

    def __init__(self, controller: Controller) -> None:
        self._c = controller
        self._program: ControlProgram | OtherProgram | PendantProgram | None = None
        self.loaded = ""

    def load(self, text: str) -> None:
        """Start a program in place of the present one, if the robot may move."""
        self.stop()
        if not self._c.may_move:
            _LOG.info("program ignored: %s, %s", self._c.robot_mode.name, self._c.safety.name)
            return
        known = "reg_offset_int" in text
        self._run(ControlProgram(self._c, text) if known else OtherProgram(self._c, text))

    def play(self) -> bool:
        """Start the loaded program file, or go on with a paused program; False where that is not possible."""
        if not self._c.may_move:
            return False
        if self._c.runtime is Runtime.PAUSED and self._program is not None:
            self._run(self._program)
            return True
        if not self.loaded or self._program is not None:
            return False
        self._run(PendantProgram(self.loaded))
        return True

    def pause(self) -> bool:
        """Hold the program that runs, and the arm; False when none does."""
        if self._program is None or self._c.runtime is not Runtime.PLAYING:
            return False
        self._c.runtime = Runtime.PAUSED
        self._c.generation += 1
        return True

    def _run(self, program: ControlProgram | OtherProgram | PendantProgram) -> None:
        self._program = program
        self._c.program_name = program.name
        self._c.runtime = Runtime.PLAYING
        self._c.generation += 1

    def step(self) -> None:
        """One cycle of the program, if one runs."""
        if self._program is None or self._c.runtime is Runtime.PAUSED:
            return
        if self._c.runtime is not Runtime.PLAYING:  # a safety stop killed it
            self._program = None
            return
        try:
            self._program.step()
        except StopProgram as end:
            _LOG.info("program %s ends: %s", self._program.name, end)
            self.stop()

    def stop(self) -> None:
        """Kill the program; the arm stops."""
        self._program = None
        if self._c.motion is not None:
            self._c.replace(Stop(self._c.target_q, self._c.planned_qd, 4.0))
        self._c.runtime = Runtime.STOPPED
        self._c.generation += 1


def _offset(text: str, name: str) -> int:
    # The client writes the number behind the comment that follows, on the next line.
    match = re.search(rf"{name}\s*=\s*(?:#[^\n]*\n\s*)?(\d+)", text)
    return int(match.group(1)) if match else 0


def _path_of(text: str) -> list[tuple[bool, bool, Array, float, float]]:
    """Way points that the client wrote into the script: straight?, is a pose?, target, speed, acceleration."""
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
