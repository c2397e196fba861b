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
from simulators.rendering.srgb import coded_table

FULL_WELL_E, READ_NOISE_E = 40_000.0, 4.0
BLACK, WHITE = 512, 16_383  # of 14 bits
BALANCE = (2.1, 1.0, 1.6)  # gains of red, green and blue that make grey grey: the filters differ
_BASE_ISO = 100.0
_TILE_ROWS = 256
_FULL = 65_535
Light = NDArray[np.uint16]  # (H, W, 3) RGB, linear


@dataclass(frozen=True, slots=True)
class Border:
    """Rows and columns around a picture; even at the left and the top, so that the pattern begins with red."""

    left: int
    top: int
    right: int
    bottom: int


EXPOSED = Border(12, 8, 20, 16)  # photosites that receive light but are not in the JPEG
SHIELDED = Border(32, 16, 0, 0)  # photosites that receive none


def bordered(picture: Bytes) -> Light:
    """The light of an sRGB picture (H, W, 3) on the sensor; its edge pixels are repeated in the border."""
    b = EXPOSED
    wide = cv2.copyMakeBorder(picture, b.top, b.bottom, b.left, b.right, cv2.BORDER_REPLICATE)
    return _LIGHT[np.asarray(wide, dtype=np.uint8)]


def light_of(linear: Array32) -> Light:
    """Linear light, 1 at saturation, as the sensor's read-out takes it."""
    return np.clip(linear * np.float32(_FULL) + np.float32(0.5), 0, _FULL).astype(np.uint16)


def read_out(light: Light, iso: float, seed: int) -> NDArray[np.uint16]:
    """The sensor's values, RGGB, with the shielded photosites.

    Args:
        light: (H, W, 3) RGB of the exposed photosites, linear, 65535 at saturation.
        iso: sensitivity; the higher, the fewer electrons make a value.
        seed: the seed of the noise.
    """
    height, width = light.shape[:2]
    rng = np.random.default_rng([seed, 14])
    full_e = FULL_WELL_E * _BASE_ISO / iso
    values = np.empty((height + SHIELDED.top, width + SHIELDED.left), dtype=np.uint16)
    for first in range(0, len(values), _TILE_ROWS):  # even, as is the shielded part: the pattern goes on
        sites = np.zeros((min(_TILE_ROWS, len(values) - first), values.shape[1]), dtype=np.float32)
        seen = light[max(0, first - SHIELDED.top) : first - SHIELDED.top + len(sites)]
        exposed = sites[len(sites) - len(seen) :, SHIELDED.left :]
        for (row, column), channel in _sites():
            share = np.float32(full_e / _FULL / BALANCE[channel])
            exposed[row::2, column::2] = seen[row::2, column::2, channel] * share
        sites += rng.standard_normal(sites.shape, dtype=np.float32) * np.sqrt(sites + np.float32(READ_NOISE_E**2))
        level = np.float32(BLACK) + sites * np.float32((WHITE - BLACK) / full_e)
        values[first : first + len(sites)] = np.clip(np.rint(level), 0, WHITE)
    return values


def picture_without_filters(light: Light, iso: float, seed: int) -> Bytes:
    """The picture (H, W, 3) RGB of a sensor that measures three colours at every pixel: sRGB, without the border."""
    inner = light[EXPOSED.top : -EXPOSED.bottom, EXPOSED.left : -EXPOSED.right]
    rng = np.random.default_rng([seed, 8])
    full_e = FULL_WELL_E * _BASE_ISO / iso
    out = np.empty(inner.shape, dtype=np.uint8)
    for first in range(0, len(inner), _TILE_ROWS):
        part = inner[first : first + _TILE_ROWS] * np.float32(full_e / _FULL)
        part += rng.standard_normal(part.shape, dtype=np.float32) * np.sqrt(part + np.float32(READ_NOISE_E**2))
        out[first : first + len(part)] = _CODED[light_of(part / np.float32(full_e))]
    return out


def colour_on(picture: NDArray[np.uint8] | Light, rgb: tuple[int, int, int]) -> Array32:
    """An sRGB colour in the values of a picture, or of light."""
    values = np.array(rgb, dtype=np.uint8)
    return (values if picture.dtype == np.uint8 else _LIGHT[values]).astype(np.float32)


def camera_picture(mosaic: NDArray[np.uint16]) -> Bytes:
    """The picture (H, W, 3) RGB that a camera makes of its sensor's values: colours, sRGB, 8 bits, no border."""
    active = mosaic[SHIELDED.top :, SHIELDED.left :].astype(np.float32)
    share = np.maximum(active - BLACK, 0.0) / np.float32(WHITE - BLACK)
    for (row, column), channel in _sites():
        share[row::2, column::2] *= BALANCE[channel]
    colour = cv2.demosaicing(light_of(share), cv2.COLOR_BayerRGGB2RGB_EA)
    b = EXPOSED
    colour = colour[b.top : -b.bottom, b.left : -b.right]
    return _CODED[np.asarray(colour, dtype=np.uint16)]


def _sites() -> Iterator[tuple[tuple[int, int], int]]:
    """Row, column and channel of each photosite of the pattern."""
    yield from (((0, 0), 0), ((0, 1), 1), ((1, 0), 1), ((1, 1), 2))


def _light_table() -> Light:
    """Light of all sRGB values."""
    x = np.arange(256) / 255
    return np.rint(_FULL * np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)).astype(np.uint16)


_CODED, _LIGHT = coded_table(_FULL), _light_table()
