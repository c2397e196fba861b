"""The one place where units are converted: metres, radians and seconds inside, other units in files and reports."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import permutations
from typing import TYPE_CHECKING, Literal, overload

if TYPE_CHECKING:  # numpy is not imported for this: the pages' start does not wait for it
    import numpy as np
    from numpy.typing import NDArray

LengthUnit = Literal["m", "cm", "mm", "in"]
METRES_PER: Mapping[LengthUnit, float] = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254}
LENGTH_WORDS: Mapping[LengthUnit, str] = {"m": "metres", "cm": "centimetres", "mm": "millimetres", "in": "inches"}
#: What lengths have to be multiplied by if one unit was taken as another, by a phrase for the mistake.
MISTAKEN_LENGTHS: Mapping[str, float] = {
    f"{LENGTH_WORDS[true]} taken as {LENGTH_WORDS[taken]}": METRES_PER[true] / METRES_PER[taken]
    for true, taken in permutations(METRES_PER, 2)
}


def mistaken_length(factor: float, relative: float) -> str:
    """Return name the mistaken unit by which lengths have to be multiplied by `factor`; "" if none is as near."""
    return next((words for words, known in MISTAKEN_LENGTHS.items() if abs(factor / known - 1) < relative), "")


@overload
def mm(length_m: float) -> float: ...
@overload
def mm(length_m: NDArray[np.float64]) -> NDArray[np.float64]: ...
def mm(length_m: float | NDArray[np.float64]) -> float | NDArray[np.float64]:
    """Millimetres of a length in metres, or of an array of lengths."""
    return 1e3 * length_m


@overload
def metres(length_mm: float) -> float: ...
@overload
def metres(length_mm: NDArray[np.float64]) -> NDArray[np.float64]: ...
def metres(length_mm: float | NDArray[np.float64]) -> float | NDArray[np.float64]:
    """Metres of a length in millimetres, or of an array of lengths: the nearest number to the decimal one."""
    return length_mm / 1e3


def deg(angle_rad: float) -> float:
    """Degrees of an angle in radians."""
    return math.degrees(angle_rad)


def mrad(angle_rad: float) -> float:
    """Milliradians of an angle in radians."""
    return 1e3 * angle_rad


def rad_of_mrad(angle_mrad: float) -> float:
    """Radians of an angle in milliradians."""
    return angle_mrad / 1e3


def um(length_m: float) -> float:
    """Micrometres of a length in metres."""
    return 1e6 * length_m


def metres_of_um(length_um: float) -> float:
    """Metres of a length in micrometres."""
    return length_um / 1e6


def ms(duration_s: float) -> float:
    """Milliseconds of a duration in seconds."""
    return 1e3 * duration_s


def seconds_of_ms(duration_ms: float) -> float:
    """Seconds of a duration in milliseconds."""
    return duration_ms / 1e3


def us(duration_s: float) -> float:
    """Microseconds of a duration in seconds."""
    return 1e6 * duration_s


def seconds_of_us(duration_us: float) -> float:
    """Seconds of a duration in microseconds."""
    return duration_us / 1e6


def nanoseconds(duration_s: float) -> int:
    """Whole nanoseconds of a duration in seconds."""
    return round(duration_s * 1e9)


def nanoseconds_of_us(duration_us: int) -> int:
    """Nanoseconds of whole microseconds, exactly."""
    return duration_us * 1000


def seconds_of_ns(duration_ns: float) -> float:
    """Seconds of a duration in nanoseconds."""
    return duration_ns / 1e9


def megabytes(size_bytes: float) -> float:
    """Megabytes (10^6 bytes) of a number of bytes."""
    return size_bytes / 1e6


def gigabytes(size_bytes: float) -> float:
    """Gigabytes (10^9 bytes) of a number of bytes."""
    return size_bytes / 1e9


def bytes_of_gigabytes(size_gb: float) -> int:
    """Bytes of a number of gigabytes (10^9 bytes)."""
    return round(size_gb * 1e9)


def megapixels(width_px: int, height_px: int) -> float:
    """Megapixels of an image of this size."""
    return width_px * height_px / 1e6
