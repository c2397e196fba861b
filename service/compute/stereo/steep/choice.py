"""One of several labels for each vertex of a mesh, so that neighbours have nearly the same: belief propagation.

Source: Felzenszwalb and Huttenlocher, "Efficient Belief Propagation for Early Vision", IJCV 2006, with min-sum
messages and a truncated linear difference.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix, diags, identity

from service.core.geometry import Array

Ints = NDArray[np.int64]
Floats = NDArray[np.float32]

_ROUNDS = 15


def edges_of(faces: Ints) -> Ints:
    """(E, 2) each edge of a triangle mesh once, the smaller index first."""
    ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    ends = np.unique(ends, axis=0)
    return ends[ends[:, 0] != ends[:, 1]]


def neighbours(edges: Ints, count: int) -> csr_matrix:
    """(V, V) 1 for each two of V vertices that share one of the edges (E, 2), else 0."""
    return _incidence(np.concatenate([edges, edges[:, ::-1]]), (count, count))


def averaged(values: NDArray[np.floating], edges: Ints, rounds: int) -> Array:
    """Values (V, ...) after so many means of each vertex with its neighbours."""
    out, count = np.asarray(values, dtype=np.float64), len(values)
    mean = neighbours(edges, count) + identity(count, format="csr")
    mean = diags(1 / np.asarray(mean.sum(axis=1)).ravel()) @ mean
    for _ in range(rounds):
        out = np.asarray(mean @ out, dtype=np.float64)
    return out


def beliefs(costs: Floats, edges: Ints, per_step: float, most: float) -> Floats:
    """(V, L) the cost of each label at each vertex, when all others choose as suits them.

    Args:
        costs: (V, L) of a label at a vertex alone.
        edges: (E, 2) of neighbours.
        per_step: cost of neighbours whose labels differ by one.
        most: cost of neighbours whose labels differ by much.
    """
    count, labels = costs.shape
    pairs = np.concatenate([edges, edges[:, ::-1]])  # of sender and receiver
    back = np.concatenate([np.arange(len(edges)) + len(edges), np.arange(len(edges))])
    received = _incidence(np.stack([pairs[:, 1], np.arange(len(pairs))], axis=1), (count, len(pairs)))
    messages = np.zeros((len(pairs), labels), dtype=np.float32)
    belief = costs.astype(np.float32)
    for _ in range(_ROUNDS):
        said = belief[pairs[:, 0]] - messages[back]
        found = said.copy()
        for k in range(1, labels):
            np.minimum(found[:, k], found[:, k - 1] + np.float32(per_step), out=found[:, k])
        for k in range(labels - 2, -1, -1):
            np.minimum(found[:, k], found[:, k + 1] + np.float32(per_step), out=found[:, k])
        np.minimum(found, said.min(axis=1, keepdims=True) + np.float32(most), out=found)
        found -= found.min(axis=1, keepdims=True)
        messages = np.float32(0.5) * (messages + found)  # damped: meshes have cycles
        belief = costs + received @ messages
    return np.asarray(belief, dtype=np.float32)


def _incidence(places: Ints, shape: tuple[int, int]) -> csr_matrix:
    return coo_matrix((np.ones(len(places), dtype=np.float32), places.T), shape).tocsr()
