"""Finds by how much two pictures of one exposure are shifted against each other, as a whole and in their parts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from service.compute.descent import gauss_newton
from service.core.geometry import Array

_TILES, _TILE_PX = (5, 4), 256
_LEAST_RESPONSE = 0.15  # of the phase correlation: share of its energy in the peak
_LEAST_SPREAD = 4.0  # standard deviation, grey levels; a plain part shows no shift
_SMOOTH_PX = 1.0  # standard deviation of the filter against noise
_MARGIN_PX, _MOST_MOVED_PX, _DONE_PX, _MOST_STEPS = 24, 3.0, 1e-3, 30
_MOST_SIGMA_PX = 0.05  # of a part's shift, as if the noise of the pixels were independent
_FEWEST = 3  # parts


@dataclass(frozen=True, slots=True)
class Shift:
    """The shift of a second picture's content against the first, in x and y, over the parts that show one.

    Attributes:
        median_px: of all parts; what is at p in the first is at p + shift in the second.
        largest_px: length of the largest shift of a part.
        parts: number of parts that show a shift.
    """

    median_px: tuple[float, float]
    largest_px: float
    parts: int

    @property
    def certain(self) -> bool:
        """Whether enough parts show a shift."""
        return self.parts >= _FEWEST


def find_shift(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> Shift:
    """The shift between two grey pictures (H, W) of one size, in parts all over them.

    Phase correlation (Kuglin and Hines 1975) finds it to a pixel; least squares on the pixels to hundredths. Neither
    depends on the brightness or the contrast, which differ between a JPEG and a developed raw file.
    """
    shifts: list[tuple[float, float]] = []
    for rows, columns in _parts(first.shape[0], first.shape[1]):
        a, b = (picture[rows, columns].astype(np.float32) for picture in (first, second))
        if min(float(a.std()), float(b.std())) < _LEAST_SPREAD:
            continue
        shift = _shift_of(a, b)
        if shift is not None:
            shifts.append(shift)
    if not shifts:
        return Shift((0.0, 0.0), 0.0, 0)
    every = np.array(shifts)
    middle = np.median(every, axis=0)
    return Shift((float(middle[0]), float(middle[1])), float(np.linalg.norm(every, axis=1).max()), len(every))


def _shift_of(a: NDArray[np.float32], b: NDArray[np.float32]) -> tuple[float, float] | None:
    """The shift of a part; None if its content does not show one."""
    window = cv2.createHanningWindow((a.shape[1], a.shape[0]), cv2.CV_32F)
    rough, response = cv2.phaseCorrelate(a.copy(), b.copy(), window)  # it multiplies them by the window in place
    if response < _LEAST_RESPONSE:
        return None
    return _refined(a, b, np.round(np.array(rough, dtype=np.float64)))


def _refined(a: NDArray[np.float32], b: NDArray[np.float32], start: Array) -> tuple[float, float] | None:
    """The shift by Gauss–Newton (Lucas and Kanade 1981), with gain and offset of the brightness estimated along."""
    a, b = (np.asarray(cv2.GaussianBlur(part, (0, 0), _SMOOTH_PX), dtype=np.float32) for part in (a, b))
    inner = slice(_MARGIN_PX, -_MARGIN_PX)
    aim = a[inner, inner].astype(np.float64).ravel()

    def linearised(shift: Array) -> tuple[Array, Array, Array]:
        """Rows of the equations, their normal matrix, and their solution: gain, offset, gain times the step."""
        # Splines: cv2.warpAffine rounds positions to 1/32 px, and the steps would never end.
        moved = ndimage.shift(b, (-shift[1], -shift[0]), order=3, mode="reflect")[inner, inner]
        dy, dx = np.gradient(moved.astype(np.float64))
        rows = np.stack([moved.ravel(), np.ones(moved.size), dx.ravel(), dy.ravel()], axis=1).astype(np.float64)
        normal = rows.T @ rows
        return rows, normal, np.linalg.solve(normal, rows.T @ aim).astype(np.float64)

    def near(shift: Array) -> bool:
        return bool(np.all(np.abs(shift - start) < _MOST_MOVED_PX))

    def step_at(shift: Array) -> Array:
        if not near(shift):
            return np.zeros(2)  # lost: there is nothing to follow
        values = linearised(shift)[2]
        return np.asarray(values[2:] / values[0], dtype=np.float64)

    shift = gauss_newton(start, step_at, lambda at, step: at + step, most=_MOST_STEPS, settled=_DONE_PX)
    if not near(shift):
        return None
    rows, normal, values = linearised(shift)
    if np.abs(values[2:] / values[0]).max() >= _DONE_PX:
        return None
    rest = aim - rows @ values
    sigma_px = np.sqrt(np.diag(np.linalg.inv(normal))[2:] * (rest @ rest) / rest.size) / abs(values[0])
    # An edge in one direction does not show the shift along it.
    return (float(shift[0]), float(shift[1])) if sigma_px.max() < _MOST_SIGMA_PX else None


def _parts(height: int, width: int) -> Iterator[tuple[slice, slice]]:
    """Rows and columns of parts that are spread over a picture, its corners included."""
    side = min(_TILE_PX, height, width)
    for top in np.linspace(0, height - side, _TILES[1]).astype(int):
        for left in np.linspace(0, width - side, _TILES[0]).astype(int):
            yield slice(top, top + side), slice(left, left + side)
