"""The simulated GRBL: its states, its real-time commands and its lines."""

from __future__ import annotations

import logging
import re
from collections import deque
from collections.abc import Callable

import numpy as np

from simulators.faults import Fault, FaultPlan
from simulators.geometry import Array
from simulators.grbl.machine import AXES, FACTORY, PLANNER_BLOCKS, Block, Machine
from simulators.grbl.replay import OWN_NAME, Said

log = logging.getLogger(__name__)

SIMULATED = Said("1.1h", (f"[VER:1.1h.20190825:{OWN_NAME}]", "[OPT:V,15,128]"), tuple(FACTORY))
_WORD = re.compile(r"([A-Z])(-?\d*\.?\d+)")
_REALTIME = (0x18, 0x3F, 0x21, 0x7E, 0x85)  # reset, ?, !, ~, jog cancel
_PIN_FAULTS = ("hard_limit", "reset_button", "door", "hold_button")


class Controller:
    """A controller and its end of the line.

    Args:
        machine: the machine that it drives.
        send: sends bytes to the host.
        faults: which messages fail; the device is `grbl`, messages are `?`, `jog`, or the line itself.
        said: settings that it lists, version and build.
    """

    def __init__(
        self, machine: Machine, send: Callable[[bytes], None], faults: FaultPlan, said: Said = SIMULATED
    ) -> None:
        self._said = said
        self._machine, self._send, self._faults = machine, send, faults
        self._state = "Alarm"
        self._heard = b""
        self._lines: deque[str] = deque()
        self._waits_for_reset = False  # after an alarm of the limits only a reset is heard
        self._asked = False  # for a report while it homes
        self._reports = 0
        self._door_s = 0.0  # how long the door stays open
        self._now_s = 0.0
        self._switch_broken = False  # at the next homing
        self.unplugged_s = 0.0  # for how long somebody pulls the cable; 0: not

    def power_up(self) -> None:
        """Start as after power-up: locked if homing is enabled, since nobody knows where the axes are."""
        self._machine.halt()
        self.unplugged_s = 0.0
        self._start_anew(self._said.state or ("Alarm" if self._machine.settings[22] else "Idle"))

    @property
    def busy(self) -> bool:
        """Return whether something changes by itself."""
        return self._machine.travelling or self._door_s > 0

    # --- the line ----------------------------------------------------------------------------------------

    def hear(self, data: bytes) -> None:
        """Take bytes: real-time commands act at once, lines wait for their turn."""
        if not data:
            return
        for byte in data:
            if byte in _REALTIME:
                self._act(byte)
            else:
                self._heard += bytes((byte,))
        *lines, self._heard = re.split(rb"[\r\n]", self._heard)
        self._lines.extend(line.decode("ascii", "replace").strip() for line in lines)

    def advance(self, now_s: float) -> None:
        """Let time pass up to now, and work off the lines."""
        elapsed_s, self._now_s = (now_s - self._now_s if self._now_s else 0.0), now_s
        if self._machine.advance(elapsed_s) and self._state == "Home":
            self._state = "Idle"
            self._say("ok")
            if self._asked:
                self._asked = False
                self._report()
        self._watch(elapsed_s)
        while self._lines and not self._waits_for_reset and self._state != "Home":
            if self._lines[0].startswith("$J=") and len(self._machine.blocks) >= PLANNER_BLOCKS:
                return  # the answer comes when the planner has room
            self._obey(self._lines.popleft().upper())

    def _watch(self, elapsed_s: float) -> None:
        if self._door_s > 0:
            self._door_s -= elapsed_s
            if self._door_s <= 0:
                self._say("[MSG:Check Door]")
        if self._state in ("Jog", "Run") and self._machine.at_a_switch and self._machine.settings[21]:
            self._alarm(1)
        elif self._state in ("Jog", "Run") and not self._machine.travelling:
            self._state = "Idle"
        elif self._state == "Jog cancel" and self._machine.feed_per_min == 0:
            self._machine.halt()
            self._state = "Idle"

    def _say(self, line: str) -> None:
        self._send(line.encode("ascii") + b"\r\n")

    # --- real-time commands ------------------------------------------------------------------------------

    def _act(self, byte: int) -> None:
        match byte:
            case 0x18:
                self._reset()
            case _ if self._waits_for_reset:
                return
            case 0x3F if self._state == "Home":
                self._asked = True
            case 0x3F:
                self._report()
            case 0x21 | 0x85 if self._state == "Jog":  # a hold during a jog drops it
                self._machine.hold()
                self._state = "Jog cancel"
            case 0x21 if self._state in ("Idle", "Run"):
                self._machine.hold()
                self._state = "Hold"
            case 0x7E if self._state == "Hold" or (self._state == "Door" and self._door_s <= 0):
                self._machine.release()
                self._state = "Run" if self._machine.blocks else "Idle"
            case _:
                pass

    def _reset(self) -> None:
        moved = self._machine.feed_per_min > 0 or self._state == "Home"
        homed = self._state == "Home"
        locked = self._state == "Alarm" or moved
        self._machine.halt()
        self._heard = b""
        self._lines.clear()
        if moved:
            self._say(f"ALARM:{6 if homed else 3}")
        self._start_anew("Alarm" if locked else "Idle")

    def _start_anew(self, state: str) -> None:
        self._state, self._waits_for_reset, self._asked, self._reports = state, False, False, 0
        self._say("")
        self._say(f"Grbl {self._said.version} ['$' for help]")
        if state == "Alarm":
            self._say("[MSG:'$H'|'$X' to unlock]")

    def _report(self) -> None:
        fault = self._faults.check("grbl", "?")
        state = {"Jog cancel": "Jog", "Hold": f"Hold:{int(self._machine.feed_per_min > 0)}"}.get(
            self._state, self._state
        )
        if state == "Door":
            state = f"Door:{2 if self._machine.feed_per_min > 0 else int(self._door_s > 0)}"
        # Offsets and overrides come with some reports only.
        work = not int(self._machine.settings[10]) & 1
        kind = "WPos" if work else "MPos"
        more = {0: f"|WCO:{_numbers(self._machine.work_offset)}", 1: "|Ov:100,100,100"}.get(self._reports % 10, "")
        place = _numbers(self._machine.position - (self._machine.work_offset if work else 0.0))
        self._reports += 1
        line = f"<{state}|{kind}:{place}|FS:{self._machine.feed_per_min:.0f},0{more}>"
        if fault is None or not self._spoiled(fault, line):
            self._say(line)

    def _alarm(self, code: int) -> None:
        """Stop and lock; after an alarm of the limits, only a reset is heard."""
        self._machine.halt()
        self._lines.clear()
        self._state = "Alarm"
        self._say(f"ALARM:{code}")
        if code in (1, 2):
            self._waits_for_reset = True
            self._say("[MSG:Reset to continue]")
        else:
            self._start_anew("Alarm")

    # --- lines -------------------------------------------------------------------------------------------

    def _obey(self, line: str) -> None:
        fault = self._faults.check("grbl", "jog" if line.startswith("$J=") else line)
        if fault is not None:
            log.info("fault %s at %s", fault.kind, line)
            if fault.kind == "reject":
                self._say(f"error:{fault.value or 20}")
                return
            if self._spoiled(fault, "ok"):
                return
        if line.startswith("$J="):
            self._answer(self._jog(line[3:]))
        elif line.startswith("$"):
            self._system(line)
        elif not line:
            self._say("ok")
        else:
            self._answer(9 if self._state in ("Alarm", "Jog", "Jog cancel") else self._block(line))

    def _answer(self, error: int) -> None:
        """`ok` for 0; nothing for a negative number, which is an alarm's."""
        if error >= 0:
            self._say(f"error:{error}" if error else "ok")

    def _system(self, line: str) -> None:
        if self._state not in ("Idle", "Alarm"):
            self._answer(8)
            return
        match line:
            case "$$":
                for number in sorted(self._said.listed):
                    value = self._machine.settings[number]
                    self._say(
                        f"${number}={value:.3f}" if number in (11, 12) or number > 99 else f"${number}={value:.12g}"
                    )
                self._say("ok")
            case "$I":
                for line_of_build in self._said.build:
                    self._say(line_of_build)
                self._say("ok")
            case "$X":
                if self._state == "Alarm":
                    self._say("[MSG:Caution: Unlocked]")
                self._state = "Idle"
                self._say("ok")
            case "$H":
                self._home()
            case _:
                self._answer(3)

    def _home(self) -> None:
        if not self._machine.settings[22]:
            self._answer(5)
        elif self._switch_broken:
            self._switch_broken = False
            self._alarm(9)
        else:
            self._state = "Home"
            self._machine.begin_homing()

    def _jog(self, text: str) -> int:
        """Plan a jog; returns the number of the error, 0 for none."""
        if self._state not in ("Idle", "Jog"):
            return 9
        words = _words(text)
        codes = {value for letter, value in words if letter == "G"}
        feed = [value for letter, value in words if letter == "F"]
        axes = [(letter, value) for letter, value in words if letter in "XYZ"]
        if not axes or codes - {20, 21, 53, 90, 91} or any(letter not in "GFXYZ" for letter, _ in words):
            return 16
        if not feed:
            return 22
        target = self._target(axes, codes)
        if self._machine.settings[20] and not self._within(target):
            return 15
        self._plan(target, feed[-1] * (25.4 if 20 in codes else 1.0), "Jog")
        return 0

    def _block(self, text: str) -> int:
        """Plan a block of G-code, G0 or G1 only; returns the number of the error, −1 after an alarm."""
        words = _words(text)
        codes = {value for letter, value in words if letter == "G"}
        axes = [(letter, value) for letter, value in words if letter in "XYZ"]
        feed = [value for letter, value in words if letter == "F"] or ([1e6] if 0 in codes else [])
        if codes - {0, 1, 21, 53, 54, 90, 91}:
            return 20
        if not axes:
            return 0
        if not feed:
            return 22
        target = self._target(axes, codes)
        if self._machine.settings[20] and not self._within(target):
            self._alarm(2)
            return -1
        self._plan(target, feed[-1], "Run")
        return 0

    def _target(self, axes: list[tuple[str, float]], codes: set[float]) -> Array:
        """Return where a block ends (3,), in machine coordinates; G53 states them, other blocks work coordinates."""
        target = self._machine.end.copy()
        for letter, value in axes:
            i = "XYZ".index(letter)
            begin = target[i] if 91 in codes else 0.0 if 53 in codes else self._machine.work_offset[i]
            target[i] = value * (25.4 if 20 in codes else 1.0) + begin
        return target

    def _within(self, target: Array) -> bool:
        return bool(np.all(target <= 0) and np.all(target >= -self._machine.per_axis(130)[:AXES]))

    def _plan(self, target: Array, feed_per_min: float, state: str) -> None:
        self._machine.blocks.append(Block(target, feed_per_min))
        self._state = state

    # --- faults ------------------------------------------------------------------------------------------

    def _spoiled(self, fault: Fault, line: str) -> bool:
        """Apply a fault; returns whether the message is lost by it."""
        seconds = float(fault.value) if isinstance(fault.value, (int, float)) else 0.5
        match fault.kind:
            case "drop":
                return True
            case "truncate":
                self._send(line[: len(line) // 2].encode())
                return True
            case "corrupt":
                self._send(b"\xff\x00" + line[1:].encode() + b"\x9e\r\n")
                return True
            case "unplug":
                self.unplugged_s = seconds
                return True
            case "no_switch":
                self._switch_broken = True
            case kind if kind in _PIN_FAULTS:
                self._press(kind, seconds)
            case _:
                pass
        return False

    def _press(self, pin: str, seconds: float) -> None:
        """Return what a person or a machine does at the controller's inputs, whenever the fault says so."""
        match pin:
            case "hard_limit":
                self._alarm(1)
            case "reset_button":
                self._reset()
            case "door":
                self._door_s, self._state = seconds, "Door"
                self._machine.halt()
                self._say("[MSG:Check Door]")
            case _:
                self._act(0x21)


def _numbers(values: Array) -> str:
    return ",".join(f"{value:.3f}" for value in values)


def _words(text: str) -> list[tuple[str, float]]:
    return [(letter, float(value)) for letter, value in _WORD.findall(text.replace(" ", ""))]
