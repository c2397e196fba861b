"""The surface of a segmented CT volume, and whether the segmentation lies on what it segments."""

from __future__ import annotations

from tempfile import TemporaryFile

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from service.compute.memory import forget_pages
from service.compute.surfaces.isosurface import surface
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, apply

SIGMA_VOXELS = 0.7  # of the smoothing, without which the surface would be the steps of the voxels
LEAST_CONTRAST_HU = 100.0  # of a sphere to its surroundings; the mean over a sphere has a noise of a few HU
_FULL = 1000
_HALO = 4  # slices on each side that the smoothing reaches
_SLICES = 64  # smoothed at a time
_INNER, _SHELL = 0.8, (1.2, 1.5)  # of the radius


def label_surface(inside: NDArray[np.bool_], T_ct_voxel: Transform) -> tuple[Array, NDArray[np.int32]]:
    """Triangles around the segmented voxels.

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
    """(N,) how much denser each sphere is than what is around it, in HU, signed.

    Spheres of a segmentation that is mirrored, or of another series, are found where there is none in the volume.

    Args:
        hounsfield: (K, J, I).
        T_ct_voxel: (4, 4) affine from voxel indices (i, j, k) to metres in the CT frame.
        centres_m: (N, 3) of the spheres in the CT frame.
        radius_m: of the spheres.
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
