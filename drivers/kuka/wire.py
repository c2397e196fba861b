"""The lines of the KUKA wire (docs/reference/kuka_protocol.md), checked and turned into records."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np

from drivers.interfaces import Array, SafetyState
from service.core.geometry import Transform
from service.core.units import deg, mm

PROTOCOL = 1
JOINTS = 7
LONGEST_LINE = 65536
Line = Mapping[str, object]
_LARGEST = 1e12  # beyond any position, time or angle; also refuses what is not a number

_SAFETY = {
    "normal": SafetyState.NORMAL,
    "protective_stop": SafetyState.PROTECTIVE_STOP,
    "external_stop": SafetyState.SAFEGUARD_STOP,
    "enabling_switch": SafetyState.SAFEGUARD_STOP,
    "emergency_stop": SafetyState.EMERGENCY_STOP,
    "fault": SafetyState.FAULT,
}


class WireError(ValueError):
    """A line of the controller that the protocol does not know; its text says why."""


@dataclass(frozen=True, slots=True)
class Hello:
    """The controller's first line."""

    model: str
    serial: str
    software: str


@dataclass(frozen=True, slots=True)
class State:
    """One line of the stream."""

    number: int
    time_s: float  # the controller's clock
    joints_rad: Array  # (7,) measured
    commanded_rad: Array  # (7,)
    T_base_flange: Transform
    mode: str
    safety: SafetyState
    safety_word: str  # the wire's own: two of its words are one state
    ready: bool
    locked: bool
    motion: int  # 0: none
    override: float


def parse(raw: bytes) -> Line:
    """The JSON object of one line. Raises WireError."""
    try:
        line: object = json.loads(raw)
    except (ValueError, RecursionError) as error:
        raise WireError(f"a line is not JSON: {raw[:60]!r}") from error
    if not isinstance(line, dict) or not isinstance(line.get("is"), str):
        raise WireError(f'a line is not an object with the field "is": {raw[:60]!r}')
    return line


def hello_of(line: Line) -> Hello:
    """The greeting. Raises WireError if it is none, or of another version of the protocol."""
    if line["is"] != "hello":
        raise WireError(f"the first line is {line['is']!r}, not 'hello'")
    if line.get("protocol") != PROTOCOL:
        raise WireError(f"the application speaks version {line.get('protocol')!r} of the protocol, not {PROTOCOL}")
    return Hello(_text(line, "model"), _text(line, "serial"), _text(line, "software"))


def state_of(line: Line) -> State:
    """A line of the stream. Raises WireError for a field that is missing or wrong."""
    safety = _text(line, "safety")
    return State(
        number=whole(line, "n"),
        time_s=float(_numbers(line, "time_s", 0)[0]),
        joints_rad=_numbers(line, "q", JOINTS),
        commanded_rad=_numbers(line, "q_command", JOINTS),
        T_base_flange=from_abc(_numbers(line, "flange_xyz_m", 3), _numbers(line, "flange_abc_rad", 3)),
        mode=_text(line, "mode"),
        safety=_SAFETY.get(safety, SafetyState.UNKNOWN),
        safety_word=safety,
        ready=_flag(line, "ready"),
        locked=_flag(line, "locked"),
        motion=whole(line, "motion"),
        override=float(_numbers(line, "override", 0)[0]),
    )


def whole(line: Line, name: str) -> int:
    """An integer field. Raises WireError."""
    value = line.get(name)
    if isinstance(value, bool) or not isinstance(value, int):
        raise WireError(f"{line['is']}: {name} is {value!r}, not an integer")
    return value


def from_abc(xyz_m: Array, abc_rad: Array) -> Transform:
    """Transform (4, 4) of KUKA's A, B, C: R = Rz(A) Ry(B) Rx(C)."""
    (sa, sb, sc), (ca, cb, cc) = np.sin(abc_rad), np.cos(abc_rad)
    T = np.eye(4)
    T[:3, :3] = [
        [ca * cb, ca * sb * sc - sa * cc, ca * sb * cc + sa * sc],
        [sa * cb, sa * sb * sc + ca * cc, sa * sb * cc - ca * sc],
        [-sb, cb * sc, cb * cc],
    ]
    T[:3, 3] = xyz_m
    return T


def to_abc(T: Transform) -> tuple[list[float], list[float]]:
    """Position in metres and A, B, C in radians of a transform (4, 4)."""
    R = T[:3, :3]
    b = float(np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0])))
    if np.hypot(R[0, 0], R[1, 0]) < 1e-9:  # A and C turn about the same axis: C is taken as 0
        return T[:3, 3].tolist(), [float(np.arctan2(-R[0, 1], R[1, 1])), b, 0.0]
    return T[:3, 3].tolist(), [float(np.arctan2(R[1, 0], R[0, 0])), b, float(np.arctan2(R[2, 1], R[2, 2]))]


def flange_words(T_base_flange: Transform) -> str:
    """A pose (4, 4) as the smartPAD shows it: X, Y, Z in millimetres, A, B, C in degrees."""
    xyz_m, abc_rad = to_abc(T_base_flange)
    return " ".join([*(f"{mm(x):.1f}" for x in xyz_m), *(f"{deg(a):.2f}" for a in abc_rad)])


def agree(answer: object, values: list[float]) -> bool:
    """Return whether the controller's answer, a number or a list of numbers, equals the values."""
    try:
        found = np.atleast_1d(np.asarray(answer, dtype=np.float64))
    except (ValueError, TypeError):
        return False
    return found.shape == (len(values),) and bool(np.max(np.abs(found - np.array(values))) < 1e-6)


def _text(line: Line, name: str) -> str:
    value = line.get(name)
    if not isinstance(value, str):
        raise WireError(f"{line['is']}: {name} is {value!r}, not a text")
    return value


def _flag(line: Line, name: str) -> bool:
    value = line.get(name)
    if not isinstance(value, bool):
        raise WireError(f"{line['is']}: {name} is {value!r}, not true or false")
    return value


def _numbers(line: Line, name: str, count: int) -> Array:
    """`count` finite numbers as an array, or one number if the count is 0."""
    value = line.get(name)
    values = cast("list[object]", value) if count and isinstance(value, list) else [value]
    numbers = [v for v in values if isinstance(v, int | float) and not isinstance(v, bool) and abs(v) < _LARGEST]
    if len(values) != max(count, 1) or len(numbers) != len(values):
        raise WireError(f"{line['is']}: {name} is {str(value)[:60]}, not {max(count, 1)} finite numbers")
    return np.array(numbers, dtype=np.float64)
