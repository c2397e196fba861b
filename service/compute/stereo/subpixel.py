"""Disparities to a small part of a pixel, by least squares between the images along the rows.

Semi-global matching prefers whole pixels. Source of the method: Lucas and Kanade, "An iterative image registration
technique", IJCAI 1981, in one dimension; grey values may differ by an offset within the window.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_WINDOW = 7
_ROUNDS = 4
_FARTHEST_PX = 1.0  # from the start: beyond it another minimum was found
_LEAST_CONTRAST = 4.0  # grey values² of the gradient's variance: less is noise
_FEWEST = 0.5  # share of the window that must be known

Image = NDArray[np.uint8]
Disparity = NDArray[np.float32]


def refined(left: Image, right: Image, disparity: Disparity) -> Disparity:
    """Disparities (H, W) of the left image, refined; as they were where the images say too little.

    NaN stays NaN, and becomes of what moves by more than _FARTHEST_PX.
    """
    known = np.isfinite(disparity)
    weight = known.astype(np.float32)
    share = np.maximum(_mean(weight), np.float32(1e-6))
    one, two = (image.astype(np.float32) for image in (left, right))
    gradient = np.asarray(cv2.Sobel(two, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8), dtype=np.float32)
    columns, rows = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in left.shape[::-1]))
    found = np.where(known, disparity, np.float32(0)).astype(np.float32)
    start = found.copy()
    for _ in range(_ROUNDS):
        partner = columns - found
        there, slope = (
            np.asarray(cv2.remap(image, partner, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), np.float32)
            for image in (two, gradient)
        )
        rest = one - there
        mean_rest, mean_slope = (
            _mean(np.asarray(weight * value, dtype=np.float32)) / share for value in (rest, slope)
        )
        variance = _mean(weight * slope**2) / share - mean_slope**2
        together = _mean(weight * slope * rest) / share - mean_slope * mean_rest
        usable = known & (variance > _LEAST_CONTRAST) & (share > _FEWEST)
        # right(x - d - s) ≈ there - slope * s
        step = np.where(usable, -together / np.maximum(variance, np.float32(1e-6)), 0.0)
        found += np.clip(step, -0.5, 0.5).astype(np.float32)
    found[~known | (np.abs(found - start) > _FARTHEST_PX)] = np.nan
    return found


def _mean(image: NDArray[np.floating]) -> NDArray[np.float32]:
    """The mean over the window around each pixel."""
    return np.asarray(cv2.boxFilter(image, cv2.CV_32F, (_WINDOW, _WINDOW)), dtype=np.float32)
