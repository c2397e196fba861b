"""The simulated light and environment box: its ASCII protocol on a pseudo-terminal."""

from __future__ import annotations

import argparse
import binascii
import json
import logging
import re
import signal
import socket
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

from simulators.faults import Fault, FaultPlan
from simulators.recordings import TAKEN_OUT, RecordedDevice, add_replay, recorded_device
from simulators.serial_line import Terminal
from simulators.serve import SimulatorError, Termination, announce
from simulators.units import ms, seconds

log = logging.getLogger(__name__)

BANNER = b"# ORTHO-LB1 light and environment box ready\r\n"
MODEL, SERIAL = "orthocapture,ORTHO-LB1 simulated", "LB-0001"
FIRMWARES = ("1.2", "1.3", "1.4")  # 1.3 has a signal tower; 1.4 ends lines with a checksum, and times the pedal
TOWER_LIGHTS = ("OFF", "GREEN", "YELLOW", "RED")
_PEDAL = re.compile(r"\d{1,15}(?: \d{1,15} \d{1,15})?")
_REFUSED = re.compile(r"refuses [^ ]+: (?P<why>\d.*)")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--link", type=Path, metavar="PATH", help="symbolic link to the pseudo-terminal")
    parser.add_argument(
        "--firmware", choices=FIRMWARES, default=FIRMWARES[-1],
        help="1.2 has no signal tower; before 1.4 lines have no checksum, and presses of the pedal no time",
    )  # fmt: skip
    parser.add_argument("--world", metavar="HOST:PORT", help="control socket of the rig that knows light and pedal")
    add_replay(parser)


def serve(args: argparse.Namespace) -> None:
    """Serve until SIGTERM; each SIGUSR1 is one press of the pedal."""
    termination = Termination()
    made = Make(MODEL, SERIAL, args.firmware)
    if args.replay:
        made = _recorded(recorded_device(args.replay, "lightbox", args.replayed))
    box = Lightbox(args.faults, World(args.world) if args.world else None, args.link, made)

    def press(number: int, frame: FrameType | None) -> None:
        del number, frame
        box.press_pedal()

    signal.signal(signal.SIGUSR1, press)
    try:
        link = None if args.link is None else str(args.link)
        announce(port=box.plug_in(), link=link, not_served=list(made.not_served))
        while not termination.is_set():
            box.serve_once(0.2)
    finally:
        box.unplug()


@dataclass(frozen=True, slots=True)
class Make:
    """Holds identity and state of a box after power-up. Answers stand without the name of the quantity."""

    model: str  # maker and model, with a comma between them
    serial: str
    firmware: str
    answers: Mapping[str, str] = field(default_factory=dict[str, str])  # recorded ones; others are the simulator's
    refusals: Mapping[str, str] = field(default_factory=dict[str, str])  # number and text of ERR; "": silence
    not_served: tuple[str, ...] = ()

    def has(self, major: int, minor: int) -> bool:
        """Return whether its firmware is this one or later."""
        numbers = self.firmware.split(".")
        if len(numbers) != 2 or not all(number.isdecimal() for number in numbers):
            return False
        return (int(numbers[0]), int(numbers[1])) >= (major, minor)


def _recorded(device: RecordedDevice) -> Make:
    """The box of a recording. Raises SimulatorError for a box without an identity."""
    answers = device.exchanges
    fields = [part.strip() for part in answers.pop("*IDN?", "").split(",")]
    if len(fields) != 4:
        raise SimulatorError(f"{device.name} stated no identity: there is nothing to serve")
    maker, model, serial, firmware = fields
    not_served: list[str] = []
    if TAKEN_OUT.search(serial):
        not_served.append(f"*IDN?, serial number: {serial}")
        serial = SERIAL
    known = ("LIGHT?", "TEMP?", "SHUTTER?", "PEDAL?")
    not_served += [f"{question}: {answer}" for question, answer in answers.items() if question not in known]
    refusals: dict[str, str] = {}
    for silent in device.silent:
        question, _, why = silent.partition(": ")
        if question in known:
            refused = _REFUSED.search(why)
            refusals[question] = refused["why"] if refused else ""
        else:
            not_served.append(f"not recorded: {silent}")
    heard = {question: answer for question, answer in answers.items() if question in known}
    if "PEDAL?" in heard and not _PEDAL.fullmatch(heard["PEDAL?"]):
        raise SimulatorError(f"the recorded answer to PEDAL? is {heard['PEDAL?']!r}: neither one number nor three")
    return Make(f"{maker},{model}", serial, firmware, heard, refusals, tuple(not_served))


class World:
    """Light, temperature and pedal as the rig reports them, cached for a moment; reconnects after a lost link."""

    def __init__(self, address: str) -> None:
        host, _, port = address.rpartition(":")
        if not port.isdigit():
            raise SimulatorError(f"--world wants HOST:PORT, not {address!r}")
        self._address = (host or "127.0.0.1", int(port))
        self._view: dict[str, float] = {}
        self._asked_s = -1.0

    def view(self) -> dict[str, float]:
        """Return light, temperature and pedal; the last known values if the world does not answer."""
        if time.monotonic() - self._asked_s > 0.05:
            try:
                with socket.create_connection(self._address, timeout=1.0) as link, link.makefile("rb") as lines:
                    link.sendall(b'{"op": "view"}\n')
                    answer = json.loads(lines.readline())
                keys = ("light_lux", "temperature_c", "pedal_presses", "pedal_ago_s")
                self._view = {key: float(answer[key]) for key in keys if key in answer}
                self._asked_s = time.monotonic()
            except (OSError, ValueError) as error:
                log.warning("the world does not answer: %s", error)
        return self._view


class Lightbox:
    """The state of the box and its end of the serial line."""

    def __init__(self, faults: FaultPlan, world: World | None, link: Path | None, make: Make) -> None:
        self._faults = faults
        self._world = world
        self._line = Terminal(link)
        self._heard = b""
        self._make = make
        self._shutter = make.answers.get("SHUTTER?", "0")
        count, *times = map(int, make.answers.get("PEDAL?", "0 0 0" if make.has(1, 4) else "0").split(" "))
        self._times_presses = bool(times)
        # By its own pedal; the last press, of the rig's pedal too.
        self._pressed, self._pressed_ms = count, times[0] if times else 0
        self._on_since_s = time.monotonic() - (seconds(times[1]) if times else 0.0)
        self._rig_pressed = 0
        self._checks = make.has(1, 4)  # whether its lines end with a checksum
        self._tower = "OFF" if make.has(1, 3) else None

    def _now_ms(self) -> int:
        return round(ms(time.monotonic() - self._on_since_s))

    def plug_in(self) -> str:
        """Plug the line in and send the banner; returns the path of the terminal."""
        name, self._heard = self._line.plug_in(), b""
        self._line.send(BANNER)
        return name

    def unplug(self) -> None:
        """Pull the cable: the terminal disappears."""
        self._line.unplug()

    def press_pedal(self) -> None:
        """Press the pedal once, without a rig."""
        self._pressed += 1
        self._pressed_ms = self._now_ms()

    def serve_once(self, timeout_s: float) -> None:
        """Answer the requests that arrive within `timeout_s`."""
        self._heard = (self._heard + self._line.receive(timeout_s))[-4096:]
        while b"\n" in self._heard:
            line, self._heard = self._heard.split(b"\n", 1)
            request = line.decode("ascii", "replace").strip()
            if request:
                self._reply(request)

    def _reply(self, request: str) -> None:
        bare, star, checksum = request.rpartition("*")
        if self._checks and star and bare:
            request, wrong = bare, checksum != _checksum(bare)
        else:
            wrong = False
        fault = self._faults.check("lightbox", request)
        said = "ERR 4 wrong checksum" if wrong else self._answer(request)
        if not said:
            return
        answer = self._line_of(said)
        if fault is not None:
            log.info("fault %s at %s", fault.kind, request)
            if self._spoiled(fault, answer):
                return
            answer = self._line_of("ERR 3 sensor fault") if fault.kind == "reject" else answer
        self._line.send(answer)

    def _line_of(self, answer: str) -> bytes:
        return (f"{answer}*{_checksum(answer)}\r\n" if self._checks else f"{answer}\r\n").encode("ascii")

    def _spoiled(self, fault: Fault, answer: bytes) -> bool:
        """Apply the fault; returns whether it replaces the answer."""
        seconds = float(fault.value) if isinstance(fault.value, (int, float)) else 0.5
        match fault.kind:
            case "drop":
                return True
            case "truncate":
                self._line.send(answer[: len(answer) // 2])
                return True
            case "corrupt":
                self._line.send(b"\xff\x00\x9e" + answer[3:] + b"\x80\xfe\n")
                return True
            case "stall":
                time.sleep(seconds)
            case "banner":
                self._line.send(BANNER)
            case "unplug":
                self.unplug()
                time.sleep(seconds)
                self.plug_in()
                return True
            case _:
                pass
        return False

    def _answer(self, request: str) -> str:
        """Return the reply to a request; "" where the box that was recorded was silent."""
        if request in self._make.refusals:
            why = self._make.refusals[request]
            return why and f"ERR {why}"
        view = self._world.view() if self._world is not None else {}
        light, warm = view.get("light_lux"), view.get("temperature_c")
        recorded = self._make.answers
        readings = {
            "*IDN?": f"*IDN {self._make.model},{self._make.serial},{self._make.firmware}",
            "LIGHT?": f"LIGHT {recorded.get('LIGHT?', '45000.0') if light is None else f'{light:.1f}'}",
            "TEMP?": f"TEMP {recorded.get('TEMP?', '21.50') if warm is None else f'{warm:.2f}'}",
            "PEDAL?": self._pedal(view),
        }
        if request in ("SHUTTER 0", "SHUTTER 1"):
            self._shutter = request[-1]
        if request in ("SHUTTER?", "SHUTTER 0", "SHUTTER 1"):
            return f"SHUTTER {self._shutter}"
        word, _, colour = request.partition(" ")
        if word in ("TOWER", "TOWER?") and self._tower is not None:
            if word == "TOWER" and colour not in TOWER_LIGHTS:
                return "ERR 2 wrong argument"
            self._tower = colour or self._tower
            log.info("the tower shows %s", self._tower)
            return f"TOWER {self._tower}"
        wrong = "ERR 2 wrong argument" if request.startswith("SHUTTER") else "ERR 1 unknown request"
        return readings.get(request, wrong)

    def _pedal(self, view: dict[str, float]) -> str:
        """Return the count of the pedal, and from firmware 1.4 the times of the last press and of this reply."""
        of_rig = int(view.get("pedal_presses", 0))
        if of_rig != self._rig_pressed:
            ago_ms = round(ms(view.get("pedal_ago_s", 0.0)))
            self._rig_pressed, self._pressed_ms = of_rig, max(self._now_ms() - ago_ms, 1)
        count = f"PEDAL {self._pressed + of_rig}"
        return f"{count} {self._pressed_ms} {self._now_ms()}" if self._times_presses else count


def _checksum(line: str) -> str:
    """Return CRC-16/XMODEM of a line as four digits to base 16, each the character 0x30 + its value."""
    checksum = binascii.crc_hqx(line.encode("ascii", "replace"), 0)
    return "".join(chr(0x30 + (checksum >> shift & 15)) for shift in (12, 8, 4, 0))
