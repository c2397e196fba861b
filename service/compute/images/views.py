"""Splits a data set's views, crops them to the specimen, and codes their depth as 16-bit images."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.core.errors import ConfigurationError, DataError
from service.core.units import metres, mm

SPARSE_VIEWS = 8
TEST_EVERY = 8  # as in LLFF and 3D Gaussian splatting


@dataclass(frozen=True, slots=True)
class Splits:
    """Names of views: `dense` is all, `sparse` a few that see the specimen best; train and test share none."""

    dense: tuple[str, ...]
    sparse: tuple[str, ...]
    train: tuple[str, ...]
    test: tuple[str, ...]

    def named(self) -> dict[str, tuple[str, ...]]:
        """Return the splits by name."""
        return {"dense": self.dense, "sparse": self.sparse, "train": self.train, "test": self.test}


def splits(sees: Mapping[str, NDArray[np.bool_]], sparse_views: int = SPARSE_VIEWS) -> Splits:
    """Return the splits of views, each with the points (N,) of the specimen that it sees.

    Raises:
        DataError: there is no view.
    """
    names = tuple(sorted(sees))
    if not names:
        raise DataError("a data set needs at least one view", remedy="Export a run with registered images")
    test = names[TEST_EVERY // 2 :: TEST_EVERY]
    train = tuple(name for name in names if name not in set(test))
    return Splits(names, sparse_choice(names, [sees[name] for name in names], sparse_views), train, test)


def sparse_choice(names: Sequence[str], sees: Sequence[NDArray[np.bool_]], count: int) -> tuple[str, ...]:
    """Return the `count` views that see most together, in the order of `names`; of equal choices the first.

    A point counts fully for the first view that sees it, half for the second, a quarter for the third: reconstruction
    needs two views of a point, and further ones help less. Chosen one after the other, which is within 63 % of the
    best choice (Nemhauser, Wolsey, Fisher, 1978).
    """
    seen, worth = np.array(sees, dtype=np.float64), np.ones(len(sees[0]))
    chosen: list[int] = []
    while len(chosen) < min(count, len(names)):
        gain = seen @ worth
        gain[chosen] = -1.0
        best = int(gain.argmax())
        chosen.append(best)
        worth *= np.where(sees[best], 0.5, 1.0)
    return tuple(names[i] for i in sorted(chosen))


FULL_HD = (1920, 1080)
_CELL_PX = 8  # crops begin at multiples of this
_LEAST_NEW = 0.05  # share of a further crop that must show parts of the specimen which no earlier crop shows

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class ImageCrop:
    """A part of an image: `x`, `y` is its first pixel."""

    x: int
    y: int
    width: int
    height: int

    def camera(self, camera: CameraModel) -> CameraModel:
        """Return the crop's camera: the principal point is shifted, all else is the same."""
        return dataclasses.replace(
            camera, width=self.width, height=self.height, cx=camera.cx - self.x, cy=camera.cy - self.y
        )

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns, for an array of the whole image."""
        return slice(self.y, self.y + self.height), slice(self.x, self.x + self.width)


def marker_free_crops(
    wanted: Mask, forbidden: Mask, size: tuple[int, int] = FULL_HD, most: int = 16
) -> list[ImageCrop]:
    """Choose crops without a forbidden pixel that show most of the wanted pixels, the best first.

    Each further crop is the one that shows most pixels which no earlier one shows, as long as these are a twentieth
    of it. Equal ones are chosen from the top left. The answer is empty where no place is free of markers.

    Args:
        wanted: (H, W) the specimen.
        forbidden: (H, W) spheres and posts.
        size: width and height of a crop.
        most: largest number of crops.

    Raises:
        ConfigurationError: a crop is larger than the image, or smaller than 8 px.
    """
    height, width = wanted.shape
    if size[0] > width or size[1] > height or min(size) < _CELL_PX:
        raise ConfigurationError(
            f"a crop of {size[0]} × {size[1]} px does not fit into an image of {width} × {height} px",
            remedy=f"Name a size within it, at least {_CELL_PX} px wide and high",
        )
    touched = (-(-size[1] // _CELL_PX), -(-size[0] // _CELL_PX))  # cells of which a crop shows any part
    whole = (size[1] // _CELL_PX, size[0] // _CELL_PX)
    places = ((height - size[1]) // _CELL_PX + 1, (width - size[0]) // _CELL_PX + 1)
    free = _window_sums(_pooled(forbidden), touched, places) == 0
    left, crops = _pooled(wanted), list[ImageCrop]()
    while len(crops) < most:
        gain = np.where(free, _window_sums(left, whole, places), -1)
        row, column = (int(k) for k in np.unravel_index(int(gain.argmax()), gain.shape))
        if gain[row, column] < max(1, _LEAST_NEW * size[0] * size[1]):
            break
        crops.append(ImageCrop(column * _CELL_PX, row * _CELL_PX, *size))
        left[row : row + whole[0], column : column + whole[1]] = 0
    return crops


def _pooled(mask: Mask) -> NDArray[np.int64]:
    """Return the pixels of the mask in each cell; cells at the right and lower edge may be cut."""
    height, width = (-(-n // _CELL_PX) for n in mask.shape)
    rows = np.add.reduceat(mask, np.arange(height) * _CELL_PX, axis=0, dtype=np.int64)
    return np.add.reduceat(rows, np.arange(width) * _CELL_PX, axis=1)


def _window_sums(cells: NDArray[np.int64], window: tuple[int, int], places: tuple[int, int]) -> NDArray[np.int64]:
    """Return (places) sums over windows of cells that begin at each place."""
    total = np.zeros((cells.shape[0] + 1, cells.shape[1] + 1), dtype=np.int64)
    np.cumsum(np.cumsum(cells, axis=0), axis=1, out=total[1:, 1:])
    (h, w), (rows, columns) = window, places
    top, bottom = total[:rows], total[h : h + rows]
    return (bottom[:, w : w + columns] - bottom[:, :columns]) - (top[:, w : w + columns] - top[:, :columns])


DEPTH_UNIT_MM = 0.1
_MOST = 65535


def coded_depth(depth_m: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Return (H, W) whole numbers of 0.1 mm, rounded; 0 where there is no depth.

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
