"""The surface of a fused field by marching cubes, tile by tile, without loose pieces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

from service.compute.ground_truth.surface import Surface
from service.compute.stereo.fusion import SIDE, Field
from service.core.errors import ComputeError

_TILE = 8  # blocks of a tile's edge
_LEAST_PIECE = 0.002  # of the largest piece's area: smaller ones are noise
_ROUND = 1e-3  # voxels: vertices of neighbouring tiles closer than this are one

Ints = NDArray[np.int64]


def surface_of(found: Field, least_maps: int) -> Surface:
    """The surface where the distance is zero, in metres, faces outward.

    Args:
        found: the field.
        least_maps: voxels that fewer maps spoke about are unknown.

    Raises:
        ComputeError: there is none.
    """
    tiles = np.floor_divide(found.blocks, _TILE)
    order = {tuple(int(x) for x in place): k for k, place in enumerate(found.blocks)}
    vertices: list[NDArray[np.float64]] = []
    faces: list[Ints] = []
    total = 0
    for tile in np.unique(tiles, axis=0):
        distance, known = _tile(found, order, tile * _TILE, least_maps)
        if not known.any() or distance[known].min() >= 0 or distance[known].max() <= 0:
            continue
        try:
            points, triangles, _, _ = marching_cubes(
                distance, 0.0, mask=_whole_cells(known), gradient_direction="descent"
            )
        except (ValueError, RuntimeError):  # the surface crosses no known cell of this tile
            continue
        vertices.append(points.astype(np.float64) + SIDE * _TILE * tile)
        faces.append(triangles.astype(np.int64) + total)
        total += len(points)
    if not vertices:
        raise ComputeError("the depth maps have no surface in common", remedy="Use more images, at smaller angles")
    merged = _merged(np.concatenate(vertices), np.concatenate(faces))
    return _without_crumbs(Surface(merged.vertices_m * found.voxel_m, merged.faces))


def _whole_cells(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Where all eight corners of a cell are known, at its last corner, which is where scikit-image looks."""
    cells = np.zeros_like(known)
    cells[1:, 1:, 1:] = True
    for i, j, k in np.ndindex(2, 2, 2):
        cells[1:, 1:, 1:] &= known[i : i + known.shape[0] - 1, j : j + known.shape[1] - 1, k : k + known.shape[2] - 1]
    return cells


def _tile(
    found: Field, order: dict[tuple[int, ...], int], first: Ints, least_maps: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Distances and known voxels of a tile, with one layer of its neighbours."""
    edge = SIDE * _TILE + 1
    distance = np.full((edge + SIDE,) * 3, 1.0, dtype=np.float32)
    known = np.zeros(distance.shape, dtype=np.bool_)
    for i in range(_TILE + 1):
        for j in range(_TILE + 1):
            for k in range(_TILE + 1):
                number = order.get((int(first[0]) + i, int(first[1]) + j, int(first[2]) + k))
                if number is None:
                    continue
                at = tuple(slice(SIDE * x, SIDE * (x + 1)) for x in (i, j, k))
                distance[at] = found.distance[number].reshape(SIDE, SIDE, SIDE)
                known[at] = (found.maps[number] >= least_maps).reshape(SIDE, SIDE, SIDE)
    return distance[:edge, :edge, :edge], known[:edge, :edge, :edge]


def _merged(vertices: NDArray[np.float64], faces: Ints) -> Surface:
    """With vertices at the same place made one."""
    keys = np.round(vertices / _ROUND).astype(np.int64)
    _, first, index = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    faces = index.reshape(-1)[faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return Surface(vertices[first], faces[whole].astype(np.int64))


def _without_crumbs(surface: Surface) -> Surface:
    """Without pieces that are much smaller than the largest."""
    n, faces = len(surface.vertices_m), surface.faces
    rows, columns = np.concatenate([faces[:, :2], faces[:, 1:]]).T
    _, piece = connected_components(coo_matrix((np.ones(len(rows)), (rows, columns)), (n, n)), directed=False)
    of_face = piece[faces[:, 0]]
    area = np.bincount(of_face, np.linalg.norm(surface.area_vectors_m2, axis=1))
    kept = faces[area[of_face] >= _LEAST_PIECE * area.max()]
    used, compact = np.unique(kept, return_inverse=True)
    return Surface(surface.vertices_m[used], compact.reshape(-1, 3).astype(np.int64))
