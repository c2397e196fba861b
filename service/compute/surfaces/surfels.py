"""Reduces a mesh or point cloud of any density to surfels: position, normal and area of equal cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.core.geometry import Array

IntArray = NDArray[np.int64]

CHUNK = 1_000_000  # faces or points processed at a time, which limits the memory
MOST_SAMPLES = 3_000_000  # of a denser mesh, every n-th face is used; a cell still holds dozens of them
_PLANAR = 0.3  # smallest over middle variance of a cell's samples, above which they are not planar
_STEADY = 0.5  # length of the sum of the area vectors over the sum of their lengths, below which they disagree


@dataclass(frozen=True, slots=True)
class Surfels:
    """Cells of surface.

    Attributes:
        position: (N, 3) centroids.
        normal: (N, 3) unit normals of either sign.
        area: (N,) m².
        outward: (N, 3) area-weighted mean of the unit normals stated by the data; 0 if there are none.
    """

    position: Array
    normal: Array
    area: Array
    outward: Array


def surfels(vertices: Array, faces: IntArray, normals: Array | None, cell: float) -> Surfels:
    """Reduce a mesh (V, 3), (F, 3), or a point cloud (no faces), to surfels of cubic cells with edge `cell`.

    Normals come from the spread of the samples in a cell, so that neither noise of single faces nor their winding
    matters; in cells with too few samples, from the faces' areas or the points' normals (V, 3).
    """
    low = vertices.min(axis=0)
    size = np.floor((vertices.max(axis=0) - low) / cell).astype(np.int64) + 2
    total = len(faces) or len(vertices)
    stride = -(-total // MOST_SAMPLES)
    keys: list[IntArray] = []
    sums: list[Array] = []
    for begin in range(0, total, CHUNK * stride):
        chosen = slice(begin, min(begin + CHUNK * stride, total), stride)
        if len(faces):
            a, b, c = (vertices[faces[chosen, k]] for k in range(3))
            vector = np.cross(b - a, c - a) * (0.5 * stride)
            point = (a + b + c) / 3 - low
            weight = np.linalg.norm(vector, axis=1)
        else:
            point = vertices[chosen] - low
            weight = np.ones(len(point))
            vector = np.zeros_like(point) if normals is None else normals[chosen]
        index = np.floor(point / cell).astype(np.int64)
        key, group = np.unique((index[:, 0] * size[1] + index[:, 1]) * size[2] + index[:, 2], return_inverse=True)
        x, y, z = point.T
        columns = [np.ones(len(point)), weight, *(weight * p for p in (x, y, z)), *vector.T]
        columns += [weight * p for p in (x * x, y * y, z * z, x * y, x * z, y * z)]
        keys.append(key)
        sums.append(summed(group, columns, len(key)))
    merged, group = np.unique(np.concatenate(keys), return_inverse=True)
    stacked = np.concatenate(sums)
    cells = summed(group, list(stacked.T), len(merged))
    return _from_sums(cells[cells[:, 1] > 0], low, cell, is_mesh=len(faces) > 0)


def _from_sums(cells: Array, low: Array, cell: float, *, is_mesh: bool) -> Surfels:
    count, weight = cells[:, 0], cells[:, 1]
    mean = cells[:, 2:5] / weight[:, None]
    vector = cells[:, 5:8] / weight[:, None]
    second = cells[:, 8:14] / weight[:, None]
    spread = np.empty((len(cells), 3, 3))
    for n, (i, j) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
        spread[:, i, j] = spread[:, j, i] = second[:, n] - mean[:, i] * mean[:, j]
    values, axes = np.linalg.eigh(spread)
    length = np.linalg.norm(vector, axis=1)
    planar = values[:, 0] < _PLANAR * values[:, 1]
    by_spread = planar & (count >= 12)
    by_vector = ~by_spread & (length > _STEADY)
    by_few = ~by_spread & ~by_vector & planar & (count >= 5)
    normal = np.where(by_vector[:, None], vector / np.maximum(length, 1e-300)[:, None], axes[:, :, 0])
    # The average area of a plane in a cell; crumpled and duplicate faces have more.
    usual = cell**2 / np.abs(normal).sum(axis=1)
    area = np.minimum(weight, 2 * usual) if is_mesh else usual
    kept = by_spread | by_vector | by_few
    return Surfels(mean[kept] + low, normal[kept], area[kept], vector[kept])


def summed(group: IntArray, columns: list[Array], n: int) -> Array:
    """Sums (n, len(columns)) of the columns (N,) over the rows of each group (N,)."""
    return np.stack([np.bincount(group, column, n).astype(np.float64) for column in columns], axis=1)


def grid_keys(points: Array, low: Array, size: IntArray, cell: float) -> IntArray:
    """Keys (N,) of the cells of points (N, 3), in a grid of `size` cells (3,) that begins one cell before `low`."""
    index = np.floor((points - low) / cell).astype(np.int64) + 1
    return (index[:, 0] * size[1] + index[:, 1]) * size[2] + index[:, 2]
