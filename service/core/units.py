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
    """Convert metres, as a number or an array, to millimetres."""
    return 1e3 * length_m


@overload
def metres(length_mm: float) -> float: ...
@overload
def metres(length_mm: NDArray[np.float64]) -> NDArray[np.float64]: ...
def metres(length_mm: float | NDArray[np.float64]) -> float | NDArray[np.float64]:
    """Convert millimetres, as a number or an array, to metres: the nearest number to the decimal one."""
    return length_mm / 1e3


def deg(angle_rad: float) -> float:
    """Convert radians to degrees."""
    return math.degrees(angle_rad)


def mrad(angle_rad: float) -> float:
    """Convert radians to milliradians."""
    return 1e3 * angle_rad


def rad_of_mrad(angle_mrad: float) -> float:
    """Convert milliradians to radians."""
    return angle_mrad / 1e3


def um(length_m: float) -> float:
    """Convert metres to micrometres."""
    return 1e6 * length_m


def metres_of_um(length_um: float) -> float:
    """Convert micrometres to metres."""
    return length_um / 1e6


def ms(duration_s: float) -> float:
    """Convert seconds to milliseconds."""
    return 1e3 * duration_s


def seconds_of_ms(duration_ms: float) -> float:
    """Convert milliseconds to seconds."""
    return duration_ms / 1e3


def us(duration_s: float) -> float:
    """Convert seconds to microseconds."""
    return 1e6 * duration_s


def seconds_of_us(duration_us: float) -> float:
    """Convert microseconds to seconds."""
    return duration_us / 1e6


def nanoseconds(duration_s: float) -> int:
    """Convert seconds to whole nanoseconds."""
    return round(duration_s * 1e9)


def nanoseconds_of_us(duration_us: int) -> int:
    """Convert whole microseconds to nanoseconds, exactly."""
    return duration_us * 1000


def seconds_of_ns(duration_ns: float) -> float:
    """Convert nanoseconds to seconds."""
    return duration_ns / 1e9


def megabytes(size_bytes: float) -> float:
    """Convert bytes to megabytes (10^6 bytes)."""
    return size_bytes / 1e6


def gigabytes(size_bytes: float) -> float:
    """Convert bytes to gigabytes (10^9 bytes)."""
    return size_bytes / 1e9


def bytes_of_gigabytes(size_gb: float) -> int:
    """Convert gigabytes (10^9 bytes) to bytes."""
    return round(size_gb * 1e9)


def megapixels(width_px: int, height_px: int) -> float:
    """Return the megapixels of an image of this size."""
    return width_px * height_px / 1e6
