"""GRBL 1.1's lines as records: status reports, answers, alarms, settings, the welcome; no I/O.

Source: the project's own description of the interface, doc/markdown/interface.md and jogging.md of gnea/grbl.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

LONGEST_LINE = 512  # bytes
STATUS, RESET, JOG_CANCEL, FEED_HOLD = b"?", b"\x18", b"\x85", b"!"  # acted on at once, without an answer
HOME = b"$H"
UNLOCKED = "MSG:Caution: Unlocked"  # said at $X, which differs from $H by one bit
STATES = ("Idle", "Run", "Hold", "Jog", "Alarm", "Door", "Check", "Home", "Sleep")
ALARMS: Mapping[int, str] = {
    1: "a limit switch was hit; the position is lost",
    2: "a motion would have left the travel of an axis",
    3: "it was reset while it moved; the position is lost",
    4: "the probe was not in its first state",
    5: "the probe touched nothing",
    6: "it was reset while it homed",
    7: "the safety door was opened while it homed",
    8: "the limit switch did not come free while it homed",
    9: "no limit switch was found while it homed",
    10: "the second limit switch of an axis was not found while it homed",
}
ERRORS: Mapping[int, str] = {
    3: "the command is not known",
    5: "homing is off ($22)",
    8: "the command is only possible while the axes stand",
    9: "it is locked by an alarm, or moves",
    11: "the line is too long",
    13: "the safety door is open",
    15: "the target is outside the travel of an axis",
    16: "the jog has no value, or a word that no jog may have",
    20: "the command is not supported",
    22: "no feed rate is set",
}
_REPORT = re.compile(r"<([A-Z][a-z]+)(?::(\d))?((?:\|[A-Za-z]+:[-\d.,A-Z]*)*)>")
_SETTING = re.compile(r"\$(\d{1,3})=(-?[\d.]+)")
_COUNT = re.compile(r"(ALARM|error):(\d{1,3})")
_FEEDBACK = re.compile(r"\[[ -~]*\]")
_WELCOME = re.compile(r"Grbl (\S+) \[")


@dataclass(frozen=True, slots=True)
class Status:
    """A status report; coordinates in the order of the axes, degrees or millimetres."""

    state: str
    substate: int
    position: tuple[float, ...] | None  # machine coordinates, MPos; None if it states work coordinates
    work_position: tuple[float, ...] | None  # WPos, which a controller states instead if $10 says so
    work_offset: tuple[float, ...] | None  # WCO = MPos − WPos; only in some reports, and after each change
    feed_override: float | None  # fraction; only in some reports


@dataclass(frozen=True, slots=True)
class Ok:
    """A line was accepted."""


@dataclass(frozen=True, slots=True)
class Refused:
    """A line was refused."""

    code: int

    @property
    def words(self) -> str:
        """The reason."""
        return ERRORS.get(self.code, "see the table of errors in its documents") + f" (error {self.code})"


@dataclass(frozen=True, slots=True)
class Alarm:
    """The controller has stopped and locked itself."""

    code: int

    @property
    def words(self) -> str:
        """The reason."""
        return ALARMS.get(self.code, "an unknown alarm") + f" (alarm {self.code})"


@dataclass(frozen=True, slots=True)
class Welcome:
    """The first line after power-up or a reset."""

    version: str


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting in the answer to `$$`."""

    number: int
    value: float


@dataclass(frozen=True, slots=True)
class Feedback:
    """A line in brackets, such as the answer to `$I`, without the brackets."""

    text: str


Message = Status | Ok | Refused | Alarm | Welcome | Setting | Feedback


def parse(line: bytes) -> Message | None:
    """The message in a line without its end; None for anything else, such as noise or half a line."""
    text = line.decode("ascii", "replace").strip() if len(line) <= LONGEST_LINE else ""
    if text == "ok":
        return Ok()
    if text.startswith("<"):
        return _status(text)
    if found := _COUNT.fullmatch(text):
        return (Alarm if found[1] == "ALARM" else Refused)(int(found[2]))
    if (found := _SETTING.fullmatch(text)) and _is_number(found[2]):
        return Setting(int(found[1]), float(found[2]))
    if found := _WELCOME.match(text):
        return Welcome(found[1])
    return Feedback(text[1:-1]) if _FEEDBACK.fullmatch(text) else None


def jog(letters: Sequence[str], target: Sequence[float], feed_per_min: float) -> bytes:
    """A line that moves straight to a target in machine coordinates. GRBL drops it when it is told to stop."""
    words = "".join(f"{letter}{value:.3f}" for letter, value in zip(letters, target, strict=True))
    return f"$J=G53G90G21{words}F{feed_per_min:.2f}".encode("ascii")


def _status(text: str) -> Status | None:
    found = _REPORT.fullmatch(text)
    if found is None or found[1] not in STATES:
        return None
    fields = dict(field.split(":", 1) for field in found[3].split("|")[1:])
    position, work, offset, override = (_numbers(fields.get(name, "")) for name in ("MPos", "WPos", "WCO", "Ov"))
    return Status(found[1], int(found[2] or 0), position, work, offset, override[0] / 100 if override else None)


def _numbers(text: str) -> tuple[float, ...] | None:
    parts = text.split(",")
    return tuple(map(float, parts)) if all(map(_is_number, parts)) else None


def _is_number(text: str) -> bool:
    return re.fullmatch(r"-?[0-9]{1,9}(\.[0-9]*)?", text) is not None
