"""Makes surfaces of CT volumes or their segmentation, and says whether an object goes on beyond the slices."""

from __future__ import annotations

from tempfile import TemporaryFile

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from skimage.measure import marching_cubes

from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, apply
from service.machine.resources import forget_pages

SLAB_VOXELS = 100_000_000  # marching cubes copies its input to float32: 400 MB
_FACES = 1_000_000  # renumbered at a time


def surface(
    volume_hu: NDArray[np.int16],
    T_ct_voxel: Transform,
    threshold_hu: float,
    *,
    slab_voxels: int = SLAB_VOXELS,
) -> tuple[Array, NDArray[np.int32]]:
    """Compute triangles where the volume crosses a threshold; denser material is inside.

    Args:
        volume_hu: (K, J, I) Hounsfield units.
        T_ct_voxel: (4, 4) affine from voxel indices (i, j, k) to metres in the CT frame.
        threshold_hu: the threshold, such as the middle between air and plastic.
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
    """Return the least and the largest value; of a mapped file, only `depth` slices are in memory at a time."""
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
    """Return vertices (i, j, k) and faces slab by slab of `depth` slices, and which vertices lie where two meet."""
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


SIGMA_VOXELS = 0.7  # of the smoothing, without which the surface would be the steps of the voxels
LEAST_CONTRAST_HU = 100.0  # of a sphere to its surroundings; the mean over a sphere has a noise of a few HU
_FULL = 1000
_HALO = 4  # slices on each side that the smoothing reaches
_SLICES = 64  # smoothed at a time
_INNER, _SHELL = 0.8, (1.2, 1.5)  # of the radius


def label_surface(inside: NDArray[np.bool_], T_ct_voxel: Transform) -> tuple[Array, NDArray[np.int32]]:
    """Return the triangles around the segmented voxels.

    The surface is where the segmentation, smoothed by a Gaussian of SIGMA_VOXELS, has the value ½. That moves a
    curved surface inwards by σ² H (H: its mean curvature): 0.005 mm for a sphere of 15 mm in voxels of 0.4 mm. What
    is thinner than about two voxels vanishes.

    Args:
        inside: (K, J, I) segmented voxels.
        T_ct_voxel: (4, 4) affine from voxel indices (i, j, k) to metres in the CT frame.

    Returns:
        As service.compute.surfaces.isosurface.surface.

    Raises:
        ComputeError: nothing, or everything, is segmented.
    """
    if inside.all() or not inside.any():
        raise ComputeError(
            "nothing, or the whole volume, is segmented", remedy="Check the segments that the step names"
        )
    size = (len(inside) + 2, inside.shape[1] + 2, inside.shape[2] + 2)  # so that a segment at the border is closed
    T = T_ct_voxel.copy()
    T[:3, 3] = apply(T_ct_voxel, -np.ones(3))
    with TemporaryFile() as file:  # twice as large as the segmentation
        smooth = np.memmap(file, np.int16, "w+", shape=size)
        for first in range(0, size[0], _SLICES):
            low, high = max(0, first - _HALO), min(size[0], first + _SLICES + _HALO)
            part = np.zeros((high - low, *size[1:]), dtype=np.float32)
            begin, end = max(low, 1), min(high, size[0] - 1)
            part[begin - low : end - low, 1:-1, 1:-1] = inside[begin - 1 : end - 1]
            part = gaussian_filter(part, SIGMA_VOXELS, mode="nearest", truncate=_HALO / SIGMA_VOXELS)
            smooth[first : first + _SLICES] = np.rint(_FULL * part[first - low : first - low + _SLICES])
            forget_pages(inside)
            forget_pages(smooth)
        return surface(smooth, T, _FULL / 2)


def sphere_contrasts(
    hounsfield: NDArray[np.int16], T_ct_voxel: Transform, centres_m: Array, radius_m: float
) -> Array:
    """Return (N,) how much denser each sphere is than what is around it, in HU, signed.

    Spheres of a segmentation that is mirrored, or of another series, are found where there is none in the volume.

    Args:
        hounsfield: (K, J, I) the volume in HU.
        T_ct_voxel: (4, 4) affine from voxel indices (i, j, k) to metres in the CT frame.
        centres_m: (N, 3) centres of the spheres in the CT frame.
        radius_m: radius of the spheres.
    """
    found = np.empty(len(centres_m))
    sides = np.linalg.norm(T_ct_voxel[:3, :3], axis=0)
    reach = np.ceil(_SHELL[1] * radius_m / sides).astype(int)
    middles = np.linalg.solve(T_ct_voxel, np.column_stack([centres_m, np.ones(len(centres_m))]).T).T[:, :3]
    for n, (middle, centre) in enumerate(zip(np.rint(middles).astype(int), centres_m, strict=True)):
        low = np.maximum(middle - reach, 0)
        high = np.minimum(middle + reach + 1, np.array(hounsfield.shape[::-1]))
        k, j, i = np.meshgrid(*(np.arange(low[axis], high[axis]) for axis in (2, 1, 0)), indexing="ij")
        away = np.linalg.norm(apply(T_ct_voxel, np.stack([i, j, k], axis=-1).astype(np.float64)) - centre, axis=-1)
        values = hounsfield[low[2] : high[2], low[1] : high[1], low[0] : high[0]].astype(np.float64)
        core, shell = (
            values[away < _INNER * radius_m],
            values[(away > _SHELL[0] * radius_m) & (away < _SHELL[1] * radius_m)],
        )
        found[n] = core.mean() - shell.mean() if len(core) and len(shell) else 0.0
    return found


def cut_voxels(ends: NDArray[np.bool_], T_ct_voxel: Transform, centres_m: Array) -> int:
    """Return the number of voxels of the object between the spheres that the first and the last slice cut.

    Only what stands between the spheres counts, as seen along the slices' line: in the rectangle of rows and columns
    around their centres. The scanner's table, below it, goes on beyond any series.

    Args:
        ends: (2, J, I) which voxels of the first and of the last slice belong to the object.
        T_ct_voxel: (4, 4) affine from voxel indices (i, j, k) to metres in the CT frame.
        centres_m: (N, 3) centres of the spheres in the CT frame, at least one.
    """
    T_voxel_ct: Transform = np.asarray(np.linalg.inv(T_ct_voxel), dtype=np.float64)
    ij = apply(T_voxel_ct, centres_m)[:, :2]
    size = np.array(ends.shape[:0:-1])
    low = np.clip(np.ceil(ij.min(axis=0)), 0, size).astype(int)
    high = np.clip(np.floor(ij.max(axis=0)) + 1, 0, size).astype(int)
    return int(np.count_nonzero(ends[:, low[1] : high[1], low[0] : high[0]]))
