"""The one place where units are converted: metres and radians inside, millimetres and degrees in reports."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, overload

if TYPE_CHECKING:  # numpy is not imported for this: the pages' start does not wait for it
    import numpy as np
    from numpy.typing import NDArray


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
