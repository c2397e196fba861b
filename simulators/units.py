"""The one place where simulators convert units: wires and files have other ones than metres and seconds."""

from __future__ import annotations

from typing import overload

from simulators.geometry import Array

UNITS = ("mm", "m", "inch")  # of lengths in files


@overload
def mm(length_m: float) -> float: ...
@overload
def mm(length_m: Array) -> Array: ...
def mm(length_m: float | Array) -> float | Array:
    """Millimetres of a length or of lengths in metres."""
    return 1000.0 * length_m


@overload
def metres(length_mm: float) -> float: ...
@overload
def metres(length_mm: Array) -> Array: ...
def metres(length_mm: float | Array) -> float | Array:
    """Metres of a length or of lengths in millimetres."""
    return length_mm / 1000.0


def radians_of_mrad(angle_mrad: float) -> float:
    """Radians of an angle in milliradians."""
    return angle_mrad / 1000.0


def in_unit(lengths_m: Array, unit: str) -> Array:
    """Lengths in metres, in one of UNITS."""
    if unit == "m":
        return lengths_m
    return mm(lengths_m) if unit == "mm" else mm(lengths_m) / 25.4


def ms(duration_s: float) -> float:
    """Milliseconds of a duration in seconds."""
    return 1000.0 * duration_s


def seconds_of_us(duration_us: float) -> float:
    """Seconds of a duration in microseconds."""
    return duration_us / 1_000_000.0


def nanoseconds(duration_s: float) -> int:
    """Nanoseconds of a duration in seconds."""
    return round(duration_s * 1_000_000_000)


def seconds(duration_ms: float) -> float:
    """Seconds of a duration in milliseconds."""
    return duration_ms / 1000.0
