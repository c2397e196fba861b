"""Whether an object goes on beyond the first or the last slice of a CT volume."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from service.core.geometry import Array, Transform, apply


def cut_voxels(ends: NDArray[np.bool_], T_ct_voxel: Transform, centres_m: Array) -> int:
    """Number of voxels of the object between the spheres that the first and the last slice cut.

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
