"""Depth as 16-bit images, in units of 0.1 mm."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from service.core.errors import DataError
from service.core.units import metres, mm

DEPTH_UNIT_MM = 0.1
_MOST = 65535


def coded_depth(depth_m: NDArray[np.float32]) -> NDArray[np.uint16]:
    """(H, W) whole numbers of 0.1 mm, rounded; 0 where there is no depth.

    Raises:
        DataError: a depth is beyond 6.5535 m.
    """
    deepest_mm = mm(float(depth_m.max(initial=0.0)))
    if deepest_mm > _MOST * DEPTH_UNIT_MM:
        raise DataError(
            f"a depth of {metres(deepest_mm):.2f} m does not fit into 16 bits in units of {DEPTH_UNIT_MM} mm",
            remedy="Write this depth as float32, or remove far surfaces from the mesh",
        )
    coded = np.empty(depth_m.shape, dtype=np.uint16)
    for row in range(0, len(depth_m), 256):
        coded[row : row + 256] = np.rint(depth_m[row : row + 256] * np.float64(mm(1.0) / DEPTH_UNIT_MM))
    return coded
