"""The transfer curve of sRGB (IEC 61966-2-1)."""

from __future__ import annotations

import numpy as np

from simulators.geometry import Array, Bytes


def coded_table(steps: int) -> Bytes:
    """The eight-bit value of each of `steps` + 1 even steps of light, from none to white."""
    x: Array = np.arange(steps + 1) / steps
    y = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(np.maximum(x, 1e-9), 1 / 2.4) - 0.055)
    return np.rint(255.0 * y).astype(np.uint8)
