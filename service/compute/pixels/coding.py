"""Depth and normals as 16-bit images: depth in units of 0.1 mm, normals as red, green, blue."""

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


def decoded_depth(coded: NDArray[np.uint16]) -> NDArray[np.float32]:
    """(H, W) metres of what `coded_depth` made, within half a unit."""
    return (coded * metres(DEPTH_UNIT_MM)).astype(np.float32)


def coded_normals(normal: NDArray[np.float32]) -> NDArray[np.uint16]:
    """(H, W, 3) of -1 … 1 as 1 … 65535; (0, 0, 0) where there is no normal."""
    coded = np.rint((normal.astype(np.float64) + 1) * ((_MOST - 1) / 2) + 1).astype(np.uint16)
    coded[~normal.any(axis=-1)] = 0
    return coded


def decoded_normals(coded: NDArray[np.uint16]) -> NDArray[np.float32]:
    """(H, W, 3) normals of what `coded_normals` made, within 2e-5; 0 where there is none."""
    normal = ((coded.astype(np.float64) - 1) * (2 / (_MOST - 1)) - 1).astype(np.float32)
    normal[~coded.any(axis=-1)] = 0.0
    return normal
