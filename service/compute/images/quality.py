"""Basic quality of a photograph, whatever it shows: the width of its edges, and whether it is black."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

_TILES, _TILE_PX = (4, 3), 512  # one tile in each part of the image is examined, at full resolution
_REACH_PX = 8  # range on either side within which an edge's height is measured
_STEP = 30.0  # smallest edge height, grey levels, well above the noise
_SLOPE = 1.0  # grey levels per pixel
_STEEPEST = 97  # percentile of the edges' slopes: gradual shading has edges too, which say nothing about sharpness
_FEWEST = 50  # edges
_DARK = 12.0  # grey level that hardly any pixel of a black image exceeds
_SIGMA_PX = 0.7  # smoothing against noise


@dataclass(frozen=True, slots=True)
class ImageQuality:
    """Sharpness and brightness of an image.

    Attributes:
        edge_px: median width of its clearest edges (height over steepest slope); 2 to 4 in a sharp image, NaN if it
            has none.
        black: whether hardly any pixel is brighter than black.
    """

    edge_px: float
    black: bool


def image_quality(grey: NDArray[np.uint8]) -> ImageQuality:
    """Quality of an image (H, W); takes some milliseconds per megapixel examined, at most three."""
    dark = float(np.percentile(grey[::4, ::4], 99)) < _DARK
    return ImageQuality(float("nan") if dark else _edge_px(grey), dark)


def _edge_px(grey: NDArray[np.uint8]) -> float:
    height, width = grey.shape
    columns, rows = _TILES
    steps: list[NDArray[np.float32]] = []
    slopes: list[NDArray[np.float32]] = []
    for part in np.array_split(np.arange(height), rows):
        for across in np.array_split(np.arange(width), columns):
            tile = grey[_middle(part), _middle(across)]
            step, slope = _edges(tile)
            steps.append(step)
            slopes.append(slope)
    step, slope = np.concatenate(steps), np.concatenate(slopes)
    if len(step) < _FEWEST:
        return float("nan")
    clear = slope >= np.percentile(slope, _STEEPEST)
    return float(np.median(step[clear] / slope[clear]))


def _middle(part: NDArray[np.int64]) -> slice:
    spare = max(0, len(part) - _TILE_PX) // 2
    return slice(int(part[0]) + spare, int(part[-1]) + 1 - spare)


def _edges(tile: NDArray[np.uint8]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Height and steepest slope of every edge in a tile."""
    smooth = np.asarray(cv2.GaussianBlur(tile, (0, 0), _SIGMA_PX), dtype=np.float32)
    across = (smooth[1:-1, 2:] - smooth[1:-1, :-2]) / 2
    along = (smooth[2:, 1:-1] - smooth[:-2, 1:-1]) / 2
    slope = np.hypot(across, along)
    around = np.ones((2 * _REACH_PX + 1, 2 * _REACH_PX + 1), dtype=np.uint8)
    step = np.asarray(cv2.dilate(smooth, around) - cv2.erode(smooth, around), dtype=np.float32)[1:-1, 1:-1]
    ridge = slope >= cv2.dilate(slope, np.ones((3, 3), dtype=np.uint8))
    clear = ridge & (step > _STEP) & (slope > _SLOPE)
    return step[clear], slope[clear]
