"""The sensor behind the lens: photosites under coloured filters, noise and 14 bits; and the picture made of them.

The sensor is larger than the picture: the JPEG leaves out a border of photosites, and beyond these lie shielded ones,
which a raw file has too.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from simulators.geometry import Array32, Bytes

FULL_WELL_E, READ_NOISE_E = 40_000.0, 4.0
BLACK, WHITE = 512, 16_383  # of 14 bits
BALANCE = (2.1, 1.0, 1.6)  # gains of red, green and blue that make grey grey: the filters differ
_BASE_ISO = 100.0
_TILE_ROWS = 256


@dataclass(frozen=True, slots=True)
class Border:
    """Rows and columns around a picture; even at the left and the top, so that the pattern begins with red."""

    left: int
    top: int
    right: int
    bottom: int


EXPOSED = Border(12, 8, 20, 16)  # photosites that receive light but are not in the JPEG
SHIELDED = Border(32, 16, 0, 0)  # photosites that receive none


def bordered(picture: Bytes) -> Array32:
    """A picture (H, W, 3) with the border of exposed photosites, for which its edge pixels are repeated."""
    b = EXPOSED
    wide = cv2.copyMakeBorder(picture, b.top, b.bottom, b.left, b.right, cv2.BORDER_REPLICATE)
    return np.asarray(wide, dtype=np.float32)


def read_out(light: Array32, iso: float, seed: int) -> NDArray[np.uint16]:
    """The sensor's values, RGGB, with the shielded photosites.

    Args:
        light: (H, W, 3) RGB of the exposed photosites, sRGB coded, 255 at saturation.
        iso: sensitivity; the higher, the fewer electrons make a value.
        seed: of the noise.
    """
    height, width = light.shape[:2]
    out = np.full((height + SHIELDED.top, width + SHIELDED.left), 0.0, dtype=np.float32)
    rng = np.random.default_rng([seed, 14])
    full_e = FULL_WELL_E * _BASE_ISO / iso
    for first in range(0, height, _TILE_ROWS):  # a multiple of two rows: the pattern goes on
        part = _linear(light[first : first + _TILE_ROWS]) * np.float32(full_e)
        sites = out[SHIELDED.top + first : SHIELDED.top + first + len(part), SHIELDED.left :]
        for (row, column), channel in _sites():
            sites[row::2, column::2] = part[row::2, column::2, channel] / np.float32(BALANCE[channel])
    out += rng.standard_normal(out.shape, dtype=np.float32) * np.sqrt(out + np.float32(READ_NOISE_E**2))
    values = np.float32(BLACK) + out * np.float32((WHITE - BLACK) / full_e)
    return np.clip(np.rint(values), 0, WHITE).astype(np.uint16)


def camera_picture(mosaic: NDArray[np.uint16]) -> Bytes:
    """The picture (H, W, 3) RGB that the camera makes of its sensor's values: colours, sRGB, 8 bits, no border."""
    active = mosaic[SHIELDED.top :, SHIELDED.left :].astype(np.float32)
    share = np.maximum(active - BLACK, 0.0) / np.float32(WHITE - BLACK)
    for (row, column), channel in _sites():
        share[row::2, column::2] *= BALANCE[channel]
    balanced = np.rint(np.clip(share, 0.0, 1.0) * 65535).astype(np.uint16)
    colour = cv2.demosaicing(balanced, cv2.COLOR_BayerRGGB2RGB_EA)
    b = EXPOSED
    colour = colour[b.top : -b.bottom, b.left : -b.right]
    return _CODED[np.asarray(colour, dtype=np.uint16)]


def _sites() -> Iterator[tuple[tuple[int, int], int]]:
    """Row, column and channel of each photosite of the pattern."""
    yield from (((0, 0), 0), ((0, 1), 1), ((1, 0), 1), ((1, 1), 2))


def _linear(coded: Array32) -> Array32:
    x = np.maximum(coded, 0.0) / np.float32(255)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)


def coded(linear: Array32) -> Array32:
    """Linear light, 1 at saturation, as sRGB values with 255 at saturation, not rounded and not clipped."""
    x = np.maximum(linear, np.float32(0))
    value = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(np.maximum(x, 1e-9), 1 / 2.4) - 0.055)
    return (255.0 * value).astype(np.float32)


_CODED = np.rint(coded(np.linspace(0.0, 1.0, 65536, dtype=np.float32))).astype(np.uint8)
