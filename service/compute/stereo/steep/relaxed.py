"""A moved surface made even, also where nothing holds it: the equilibrium of a thin plate on springs.

Source of the plate on a mesh: Kobbelt et al., "Interactive Multi-Resolution Modeling on Arbitrary Meshes", SIGGRAPH
1998. Its bending at a vertex is the distance to the mean of the neighbours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, diags, identity
from scipy.sparse.linalg import splu

from service.compute.stereo.steep.choice import neighbours
from service.core.geometry import Array

_LEAST_SPRING = 1e-6  # keeps in place what has no path to a vertex that is held
_ROUNDS = 3  # solutions; each after the first with weaker springs where the one before is far from them


def relaxed(
    points_m: Array, held: Array, fixed: NDArray[np.bool_], edges: NDArray[np.int64], even_m: float, slip_m: float
) -> Array:
    """(V, 3) vertices for which the energy of springs and bending together is least.

    Args:
        points_m: (V, 3) vertices, at which the springs have no force.
        held: (V,) stiffness of the springs, 0 to 1.
        fixed: (V,) vertices that do not move.
        edges: (E, 2) of neighbours.
        even_m: length over which the plate evens out what springs of stiffness 1 hold.
        slip_m: extension that halves the stiffness of a spring, so that single errors do not hold the plate.
    """
    if fixed.all():
        return points_m.copy()
    free, rest = np.flatnonzero(~fixed), np.flatnonzero(fixed)
    edge_m = np.median(np.linalg.norm(points_m[edges[:, 0]] - points_m[edges[:, 1]], axis=1))
    bending = _bending(edges, len(points_m))
    plate = (even_m / edge_m) ** 4 * (bending.T @ bending).tocsr()[free]
    inner, outer = plate[:, free], plate[:, rest] @ points_m[rest]
    out = points_m.copy()
    for _ in range(_ROUNDS):
        extension = np.linalg.norm(out[free] - points_m[free], axis=1)
        spring = np.maximum(held[free] / (1 + (extension / slip_m) ** 2), _LEAST_SPRING)
        out[free] = splu((inner + diags(spring)).tocsc()).solve(spring[:, None] * points_m[free] - outer)
    return out


def _bending(edges: NDArray[np.int64], count: int) -> csr_matrix:
    """(V, V) takes vertices to what separates each from the mean of its neighbours."""
    beside = neighbours(edges, count)
    mean = diags(1 / np.maximum(np.asarray(beside.sum(axis=1), dtype=np.float64).ravel(), 1)) @ beside
    return (identity(count, format="csr") - mean).tocsr()
