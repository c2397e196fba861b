"""A moved surface made even, also where nothing holds it: the equilibrium of a thin plate on springs.

Source of the plate on a mesh: Kobbelt et al., "Interactive Multi-Resolution Modeling on Arbitrary Meshes", SIGGRAPH
1998. Its bending at a vertex is the distance to the mean of the neighbours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, diags, identity
from scipy.sparse.linalg import splu

from service.core.geometry import Array

_LEAST_SPRING = 1e-6  # keeps in place what has no path to a vertex that is held


def relaxed(points_m: Array, held: Array, fixed: NDArray[np.bool_], edges: NDArray[np.int64], even_m: float) -> Array:
    """(V, 3) vertices for which the energy of springs and bending together is least.

    Args:
        points_m: (V, 3) vertices, at which the springs have no force.
        held: (V,) stiffness of the springs, 0 to 1.
        fixed: (V,) vertices that do not move.
        edges: (E, 2) of neighbours.
        even_m: length over which the plate evens out what springs of stiffness 1 hold.
    """
    if fixed.all():
        return points_m.copy()
    count, free = len(points_m), np.flatnonzero(~fixed)
    both = np.concatenate([edges, edges[:, ::-1]])
    beside = coo_matrix((np.ones(len(both)), both.T), (count, count)).tocsr()
    bending = identity(count, format="csr") - diags(1 / np.maximum(np.diff(beside.indptr), 1)) @ beside
    edge_m = np.median(np.linalg.norm(points_m[edges[:, 0]] - points_m[edges[:, 1]], axis=1))
    plate = (even_m / edge_m) ** 4 * (bending.T @ bending).tocsr()[free]
    spring = np.maximum(held[free], _LEAST_SPRING)
    force = spring[:, None] * points_m[free] - plate[:, np.flatnonzero(fixed)] @ points_m[fixed]
    out = points_m.copy()
    out[free] = splu((plate[:, free] + diags(spring)).tocsc()).solve(force)
    return out
