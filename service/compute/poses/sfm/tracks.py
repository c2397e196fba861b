"""Tracks of structure from motion: the observations of scene points in images."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from service.core.geometry import Array


@dataclass(frozen=True, slots=True)
class Tracks:
    """Observations of scene points.

    Attributes:
        image: (O,) index of the image, in the order of the model's poses.
        point: (O,) index of the point.
        pixels: (O, 2) in the image as captured.
        points: (P, 3) positions in the model's frame and unit; every point has at least two observations.
    """

    image: NDArray[np.int64] = field(repr=False)
    point: NDArray[np.int64] = field(repr=False)
    pixels: Array = field(repr=False)
    points: Array = field(repr=False)

    def thinned(self, most: int) -> Tracks:
        """Reduce to about `most` observations, keeping the longest tracks; unchanged if there are few enough.

        Tracks are taken in the order of their length, after each image has got its share.
        """
        if len(self.image) <= most:
            return self
        length = np.bincount(self.point, minlength=len(self.points))
        n_images = int(self.image.max()) + 1
        keep = np.zeros(len(self.points), dtype=bool)
        share = max(1, most // n_images // 2)
        order = np.argsort(-length[self.point], kind="stable")
        for i in range(n_images):  # so that a weakly connected image keeps its few points
            mine = order[self.image[order] == i][:share]
            keep[self.point[mine]] = True
        for p in np.argsort(-length, kind="stable"):
            if length[keep].sum() >= most:
                break
            keep[p] = True
        number = np.cumsum(keep) - 1
        rows = keep[self.point]
        return Tracks(self.image[rows], number[self.point[rows]], self.pixels[rows], self.points[keep])
