"""Isosurface of a CT volume by marching cubes, in slabs if the volume is large."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from skimage.measure import marching_cubes

from service.compute.memory import forget_pages
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, apply

SLAB_VOXELS = 100_000_000  # marching cubes copies its input to float32: 400 MB
_FACES = 1_000_000  # renumbered at a time


def surface(
    volume_hu: NDArray[np.int16],
    T_ct_voxel: Transform,
    threshold_hu: float,
    *,
    slab_voxels: int = SLAB_VOXELS,
) -> tuple[Array, NDArray[np.int32]]:
    """Triangles where the volume crosses a threshold; denser material is inside.

    Args:
        volume_hu: (K, J, I) Hounsfield units.
        T_ct_voxel: (4, 4) affine from voxel indices (i, j, k) to metres in the CT frame.
        threshold_hu: for example, the middle between air and plastic.
        slab_voxels: approximate limit of voxels processed at a time.

    Returns:
        Vertices (V, 3) in metres in the CT frame, and faces (F, 3), counter-clockwise as seen from outside. The
        surface is open where the object reaches the border of the volume.

    Raises:
        ComputeError: the volume is not three-dimensional, or never crosses the threshold.

    Source: Lewiner et al., "Efficient implementation of Marching Cubes' cases with topological guarantees", 2003
    (scikit-image).
    """
    if volume_hu.ndim != 3 or min(volume_hu.shape) < 2:
        raise ComputeError(f"a volume of shape {volume_hu.shape} has no surface", remedy="Check the CT series")
    depth = max(2, slab_voxels // volume_hu[0].size)
    low, high = _range(volume_hu, depth)
    # Avoid integers: a voxel exactly at the level would give triangles without area.
    level = threshold_hu + 0.25 if float(threshold_hu).is_integer() else float(threshold_hu)
    if not low < level < high:
        raise ComputeError(
            f"no surface at {threshold_hu:g} HU: the volume holds {low} to {high} HU",
            remedy="Choose a threshold between air and the wanted material",
        )
    points, triangles = _sewn(*_slabs(volume_hu, level, depth))
    if not len(points):
        # Only possible if neighbouring slices are on opposite sides of the level and none crosses it within.
        raise ComputeError(f"no surface at {threshold_hu:g} HU", remedy="Choose another threshold")
    # scikit-image's faces for (k, j, i) are clockwise as seen from outside; the change to (i, j, k) mirrors them, and
    # a left-handed T_ct_voxel mirrors them back.
    if np.linalg.det(T_ct_voxel[:3, :3]) < 0:
        triangles = triangles[:, ::-1]
    return apply(T_ct_voxel, points), np.ascontiguousarray(triangles, dtype=np.int32)


def _range(volume_hu: NDArray[np.int16], depth: int) -> tuple[int, int]:
    """The least and the largest value; of a mapped file, only `depth` slices are in memory at a time."""
    lows: list[int] = []
    highs: list[int] = []
    for first in range(0, len(volume_hu), depth):
        slab = volume_hu[first : first + depth]
        lows.append(int(slab.min()))
        highs.append(int(slab.max()))
        forget_pages(volume_hu)
    return min(lows), max(highs)


def _slabs(
    volume_hu: NDArray[np.int16], level: float, depth: int
) -> tuple[Array, NDArray[np.int32], NDArray[np.bool_]]:
    """Vertices (i, j, k) and faces slab by slab of `depth` slices, and which vertices lie where two slabs meet."""
    found: list[tuple[int, NDArray[np.float32], NDArray[np.int32]]] = []
    seams: list[NDArray[np.bool_]] = [np.zeros(0, dtype=np.bool_)]
    last = volume_hu.shape[0] - 1
    for first in range(0, last, depth):
        # Neighbouring slabs share one slice, in which their surfaces meet.
        end = min(first + depth, last)
        slab = volume_hu[first : end + 1]
        if slab.min() < level < slab.max():
            kji, triangles = marching_cubes(slab.astype(np.float32), level, gradient_direction="descent")[:2]
            found.append((first, kji, triangles))
            seams.append(((kji[:, 0] == 0) & (first > 0)) | ((kji[:, 0] == end - first) & (end < last)))
        forget_pages(volume_hu)
    vertices = np.empty((sum(len(kji) for _, kji, _ in found), 3))
    faces = np.empty((sum(len(triangles) for _, _, triangles in found), 3), dtype=np.int32)
    point, face = 0, 0
    while found:  # each slab's own arrays are freed as soon as they are copied
        first, kji, triangles = found.pop(0)
        vertices[point : point + len(kji)] = kji[:, ::-1]
        vertices[point : point + len(kji), 2] += first
        np.add(triangles, point, out=faces[face : face + len(triangles)], casting="unsafe")
        point, face = point + len(kji), face + len(triangles)
    return vertices, faces, np.concatenate(seams)


def _sewn(points: Array, faces: NDArray[np.int32], on_seam: NDArray[np.bool_]) -> tuple[Array, NDArray[np.int32]]:
    """Merge the vertices (voxel units) that two slabs share; drop faces that collapse."""
    seam = np.flatnonzero(on_seam)
    if len(seam):
        _, first, index = np.unique(np.round(points[seam], 3), axis=0, return_index=True, return_inverse=True)
        target = seam[first][index.reshape(-1)]
        kept = np.ones(len(points), dtype=np.bool_)
        kept[seam[target != seam]] = False
        rank = np.cumsum(kept, dtype=np.int32) - np.int32(1)
        rank[seam] = rank[target]
        points = points[kept]
        for begin in range(0, len(faces), _FACES):
            faces[begin : begin + _FACES] = rank[faces[begin : begin + _FACES]]
    a, b, c = faces.T
    whole = (a != b) & (b != c) & (c != a)
    return points, faces if whole.all() else faces[whole]
