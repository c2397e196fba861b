"""Programs from the script port or the pendant, and the interpreter that runs one of them."""

from __future__ import annotations

import logging
import re

from simulators.ur_controller.control_script import ControlProgram, StopProgram
from simulators.ur_controller.controller import Controller
from simulators.ur_controller.modes import Runtime
from simulators.ur_controller.motion import Stop

_LOG = logging.getLogger(__name__)
_WRITE = re.compile(r"\bwrite_output_integer_register\(\s*(\d+)\s*(?:\+\s*(\d+)\s*)?,\s*(-?\d+)\s*\)")
_SCRIPT_ERRORS = (ValueError, IndexError, ArithmeticError)  # raised for a text that is not a valid program
_LONGEST_SCRIPT = 1 << 20  # characters
_OPENS_S = 0.5  # in which a person opens a program on the pendant, none running
_OTHER_S = 0.1  # time for which an uninterpreted program appears to run


class ScriptReader:
    """Splits the text from the script port into programs: `end` in column 0 closes one."""

    def __init__(self) -> None:
        self._lines: list[str] = []
        self._length = 0
        self._rest = ""

    def feed(self, data: bytes) -> list[str]:
        """Add bytes; returns the programs that are now complete."""
        programs: list[str] = []
        *lines, rest = (self._rest + data.decode("utf-8", "replace")).split("\n")
        self._rest = rest[-_LONGEST_SCRIPT:]
        for line in lines:
            if not self._lines and not line.startswith(("def ", "sec ")):
                if line.strip():
                    programs.append(line)
                continue
            self._lines.append(line)
            self._length += len(line)
            if self._length > _LONGEST_SCRIPT:
                self._lines.clear()
                self._length = 0
                continue
            if line.rstrip() == "end":
                programs.append("\n".join(self._lines))
                self._lines.clear()
                self._length = 0
        return programs


class OtherProgram:
    """Any other script: only its writes to integer registers are executed, one per cycle; then it ends."""

    def __init__(self, controller: Controller, text: str) -> None:
        match = re.match(r"(?:def|sec)\s+(\w+)", text)
        self.name = match.group(1) if match else "unnamed"
        self._c = controller
        self._ends_s = controller.time_s + _OTHER_S
        self._writes = [(int(at) + int(more or 0), _int32(value)) for at, more, value in _WRITE.findall(text)]

    def step(self) -> None:
        """Run one cycle. Raises StopProgram at the end of the script."""
        if self._writes:
            at, value = self._writes.pop(0)
            self._c.outputs.ints[at] = value
            self._c.generation += 1
        elif self._c.time_s >= self._ends_s:
            raise StopProgram("at its end; the rest of it is not modelled")


def _int32(digits: str) -> int:
    return (int(digits) + (1 << 31)) % (1 << 32) - (1 << 31)


class PendantProgram:
    """A program file loaded and started by the dashboard: it runs until it is stopped."""

    def __init__(self, name: str) -> None:
        self.name = name

    def step(self) -> None:
        """Run one cycle, which does nothing."""


class Interpreter:
    """Runs at most one program; `loaded` is the program file that is open on the pendant."""

    def __init__(self, controller: Controller) -> None:
        self._c = controller
        self._program: ControlProgram | OtherProgram | PendantProgram | None = None
        self.loaded = ""
        self._foreign_at_s: float | None = None  # when the program that a person has opened begins

    def run_foreign(self, name: str) -> None:
        """End the program, open this file on the pendant, and start it."""
        self.stop()
        self.loaded = name
        self._foreign_at_s = self._c.time_s + _OPENS_S

    def load(self, text: str) -> None:
        """Start a program in place of the current one, if the robot may move."""
        self.stop()
        if not self._c.may_move:
            _LOG.info("program ignored: %s, %s", self._c.robot_mode.name, self._c.safety.name)
            return
        known = "reg_offset_int" in text
        try:
            program = ControlProgram(self._c, text) if known else OtherProgram(self._c, text)
        except _SCRIPT_ERRORS as error:  # as on a controller that cannot compile it
            _LOG.warning("program refused: %s", error)
            return
        self._run(program)

    def play(self) -> bool:
        """Start the loaded program file or resume a paused program; False if neither is possible."""
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
        """Pause the running program and the arm; False if no program runs."""
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
        """Run one cycle of the program, if one is running."""
        if self._foreign_at_s is not None and self._c.time_s >= self._foreign_at_s:
            self._foreign_at_s = None
            self.play()
        if self._program is None or self._c.runtime is Runtime.PAUSED:
            return
        if self._c.runtime is not Runtime.PLAYING:  # a safety stop ended it
            self._program = None
            return
        try:
            self._program.step()
        except StopProgram as end:
            _LOG.info("program %s ends: %s", self._program.name, end)
            self.stop()
        except _SCRIPT_ERRORS as error:  # like a controller, which ends a program at its first runtime error
            _LOG.warning("program %s fails: %s", self._program.name, error)
            self.stop()

    def stop(self) -> None:
        """End the program; the arm stops."""
        self._program = None
        if self._c.motion is not None:
            self._c.replace(Stop(self._c.target_q, self._c.planned_qd, 4.0))
        self._c.runtime = Runtime.STOPPED
        self._c.generation += 1
