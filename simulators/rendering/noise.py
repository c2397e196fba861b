"""Lattice noise for textures, with features that do not depend on the resolution at which it is drawn."""

from __future__ import annotations

import cv2
import numpy as np

from simulators.geometry import Array32


class Noise:
    """Noise of one texture with `shape` (rows, columns) texels covering `extent_m` (rows, columns) metres."""

    def __init__(self, seed: int, shape: tuple[int, int], extent_m: tuple[float, float]) -> None:
        self.shape = shape
        self.extent_m = extent_m
        self._seed = seed

    def field(self, name: int, cell_m: float, stretch: float = 1.0) -> Array32:
        """Return noise of about N(0, 1) with features of `cell_m`, `stretch` times as long along axis 0."""
        rows = max(2, round(self.extent_m[0] / (cell_m * stretch)))
        columns = max(2, round(self.extent_m[1] / cell_m))
        lattice = np.random.default_rng([self._seed, name]).standard_normal((rows, columns), dtype=np.float32)
        shrinks = rows > self.shape[0] or columns > self.shape[1]
        out = cv2.resize(lattice, self.shape[::-1], interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
        return np.asarray(out, dtype=np.float32)

    def octaves(self, name: int, cell_m: float, count: int, gain: float = 0.6, stretch: float = 1.0) -> Array32:
        """Sum `count` fields, each with half the feature size and `gain` times the amplitude of the last.

        The result has about unit variance.
        """
        total = np.zeros(self.shape, dtype=np.float32)
        power = 0.0
        for k in range(count):
            weight = gain**k
            total += np.float32(weight) * self.field(name * 100 + k, cell_m / 2**k, stretch)
            power += weight * weight
        return total / np.float32(np.sqrt(power) * 0.8)

    def rng(self, name: int) -> np.random.Generator:
        """Return a generator for strokes and spots that is the same at every resolution."""
        return np.random.default_rng([self._seed, name, 1])


def ramp(low: float, high: float, x: Array32) -> Array32:
    """Smooth ramp: 0 below `low`, 1 above `high`, cubic between."""
    t = np.clip((x - np.float32(low)) / np.float32(high - low), 0.0, 1.0)
    return t * t * (np.float32(3.0) - 2.0 * t)


def mixed(base: Array32, colour: tuple[float, float, float], weight: Array32) -> Array32:
    """Blend base (H, W, 3) towards a linear colour by weight (H, W)."""
    w = weight[..., None]
    return base + w * (np.array(colour, dtype=np.float32) - base)
