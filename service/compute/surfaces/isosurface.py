"""Isosurface of a CT volume by marching cubes, in slabs if the volume is large."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from skimage.measure import marching_cubes

from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, apply

SLAB_VOXELS = 100_000_000  # marching cubes copies its input to float32: 400 MB


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
    low, high = int(volume_hu.min()), int(volume_hu.max())
    # Avoid integers: a voxel exactly at the level would give triangles without area.
    level = threshold_hu + 0.25 if float(threshold_hu).is_integer() else float(threshold_hu)
    if not low < level < high:
        raise ComputeError(
            f"no surface at {threshold_hu:g} HU: the volume holds {low} to {high} HU",
            remedy="Choose a threshold between air and the wanted material",
        )
    points, triangles = _sewn(*_slabs(volume_hu, level, max(2, slab_voxels // volume_hu[0].size)))
    if not len(points):
        # Only possible if neighbouring slices are on opposite sides of the level and none crosses it within.
        raise ComputeError(f"no surface at {threshold_hu:g} HU", remedy="Choose another threshold")
    # scikit-image's faces for (k, j, i) are clockwise as seen from outside; the change to (i, j, k) mirrors them, and
    # a left-handed T_ct_voxel mirrors them back.
    if np.linalg.det(T_ct_voxel[:3, :3]) < 0:
        triangles = triangles[:, ::-1]
    return apply(T_ct_voxel, points), np.ascontiguousarray(triangles, dtype=np.int32)


def _slabs(
    volume_hu: NDArray[np.int16], level: float, depth: int
) -> tuple[Array, NDArray[np.int64], NDArray[np.bool_]]:
    """Vertices (i, j, k) and faces slab by slab of `depth` slices, and which vertices lie where two slabs meet."""
    vertices: list[Array] = [np.zeros((0, 3))]
    faces: list[NDArray[np.int64]] = [np.zeros((0, 3), dtype=np.int64)]
    seams: list[NDArray[np.bool_]] = [np.zeros(0, dtype=np.bool_)]
    count = 0
    last = volume_hu.shape[0] - 1
    for first in range(0, last, depth):
        # Neighbouring slabs share one slice, in which their surfaces meet.
        end = min(first + depth, last)
        slab = volume_hu[first : end + 1]
        if not slab.min() < level < slab.max():
            continue
        kji, triangles, _, _ = marching_cubes(slab.astype(np.float32), level, gradient_direction="descent")
        on_seam = ((kji[:, 0] == 0) & (first > 0)) | ((kji[:, 0] == end - first) & (end < last))
        ijk = kji[:, ::-1].astype(np.float64)
        ijk[:, 2] += first
        vertices.append(ijk)
        seams.append(on_seam)
        faces.append(triangles.astype(np.int64) + count)
        count += len(ijk)
    return np.concatenate(vertices), np.concatenate(faces), np.concatenate(seams)


def _sewn(points: Array, faces: NDArray[np.int64], on_seam: NDArray[np.bool_]) -> tuple[Array, NDArray[np.int64]]:
    """Merge the vertices (voxel units) that two slabs share; drop faces that collapse."""
    seam = np.flatnonzero(on_seam)
    if len(seam):
        _, first, index = np.unique(np.round(points[seam], 3), axis=0, return_index=True, return_inverse=True)
        target = np.arange(len(points))
        target[seam] = seam[first][index.reshape(-1)]
        kept = np.unique(target)
        rank = np.zeros(len(points), dtype=np.int64)
        rank[kept] = np.arange(len(kept))
        points, faces = points[kept], rank[target][faces]
    a, b, c = faces.T
    return points, faces[(a != b) & (b != c) & (c != a)]
