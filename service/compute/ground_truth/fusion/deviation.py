"""The deviation of a CT from a scan as a smooth field, which goes on into the parts that the scan does not show.

A CT deviates from the true surface by up to some tenths of a millimetre where the material changes (bone, steel) and
where the surface is curved. Without this field, that deviation would be a step at the seam.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import LinearOperator, cg

from service.compute.ground_truth.fusion.overlap import Mask
from service.compute.ground_truth.surface import FACES, IntArray, Surface
from service.core.errors import ComputeError
from service.core.geometry import Array

_ITERATIONS, _RELATIVE = 2000, 1e-3
_FACES = 500_000  # whose edges are sorted at a time, which limits the memory
_AVERAGED = 4  # times in each attempt
_ALIKE = (1, 1, 2)  # rings of neighbours around faces that turn over: in them, moves become alike
_ROUNDED = (0,) * 10  # then their own corners are evened out
_STIFF = (
    1,
    1,
    2,
    2,
    4,
    4,
    8,
    8,
    16,
    16,
    32,
    32,
    64,
    64,
)  # at last they move as one piece; over so many rings, into the rest


@dataclass(frozen=True, slots=True)
class FieldLengths:
    """How smooth the field is.

    Attributes:
        smoothing_m: over which the field averages the scan's noise.
        reach_m: over which it decays where the scan shows nothing.
    """

    smoothing_m: float = 0.0007
    reach_m: float = 0.006


def deviation_field(surface: Surface, links: csr_matrix, known_m: Array, known: Mask, lengths: FieldLengths) -> Array:
    """(V,) metres: follows `known_m` where it is `known`, and decays from there along the surface.

    It minimises the squared differences over the edges, with weights towards the known values and, elsewhere, 0.

    Args:
        surface: a mesh.
        links: its `adjacency`.
        known_m: (V,) deviations, along the normals.
        known: (V,) where they count.
        lengths: of smoothing and decay.

    Raises:
        ComputeError: the solver does not converge.
    """
    edge_m = _usual_edge(surface)
    pull = np.where(known, (edge_m / lengths.smoothing_m) ** 2, (edge_m / lengths.reach_m) ** 2)
    diagonal = np.asarray(links.sum(axis=1)).ravel() + pull
    wanted = np.where(known, pull * known_m, 0.0)
    n = len(wanted)
    matrix = LinearOperator((n, n), matvec=lambda x: diagonal * x - links @ x, dtype=np.float64)
    inverse = LinearOperator((n, n), matvec=lambda x: x / diagonal, dtype=np.float64)
    field, left = cg(matrix, wanted, rtol=_RELATIVE, maxiter=_ITERATIONS, M=inverse)
    if left != 0:
        raise ComputeError("the deviation of the CT from the scan has no smooth field", remedy="Check both meshes")
    return np.asarray(field, dtype=np.float64)


def moved_unfolded(surface: Surface, move_m: Array, known: csr_matrix | None = None) -> tuple[Surface, int]:
    """The surface after a displacement (V, 3) of its vertices, and the number of faces that are turned over.

    Around faces that turn over (mostly slivers of marching cubes), displacements are averaged with those of their
    neighbours: equal displacements turn no face. Where that is not enough, vertices move to the mean of their
    neighbours. Faces that still turn over move as one piece with what is around them. `known` is the surface's
    `adjacency`, if it was computed before.
    """
    points = surface.vertices_m + move_m
    folded = _folded(surface, points, np.arange(len(surface.faces)))
    if not len(folded):
        return Surface(points, surface.faces), 0
    links = adjacency(surface) if known is None else known
    means: csr_matrix = (diags(1 / np.maximum(np.asarray(links.sum(axis=1)).ravel(), 1.0)) @ links).tocsr()
    for rings in (*_ALIKE, *_ROUNDED):
        around = np.zeros(len(points))
        around[surface.faces[folded].ravel()] = 1.0
        for _ in range(rings):
            around += links @ around
        chosen = np.flatnonzero(around)
        mean = means[chosen]
        fixed = surface.vertices_m if rings else np.zeros_like(points)
        for _ in range(_AVERAGED):
            move = points - fixed
            points[chosen] = fixed[chosen] + 0.5 * (move[chosen] + mean @ move)
        folded = _folded(surface, points, np.flatnonzero(surface.touching(around > 0)))  # the others lie as before
        if not len(folded):
            return Surface(points, surface.faces), 0
    still = folded
    for rings in _STIFF:
        share, piece = _pieces(surface, links, folded, rings)
        move = points - surface.vertices_m
        whole = np.maximum(np.bincount(piece, share), 1.0)  # 0 for vertices of no piece, whose share is 0 too
        mean = np.stack([np.bincount(piece, share * move[:, k]) / whole for k in range(3)], axis=1)
        points = points + share[:, None] * (mean[piece] - move)
        still = _folded(surface, points, np.flatnonzero(surface.touching(share > 0)))
        if not len(still):
            return Surface(points, surface.faces), 0
        folded = np.union1d(folded, still)  # those that lie straight now stay in their pieces
    return Surface(points, surface.faces), len(still)


def _pieces(surface: Surface, links: csr_matrix, folded: IntArray, rings: int) -> tuple[Array, IntArray]:
    """(V,) share with which each vertex moves as a part of its piece, and (V,) the piece's number.

    The share is 1 at the corners of the folded faces and their neighbours, and passes to 0 over `rings` rings.
    """
    near = np.zeros(len(surface.vertices_m), dtype=bool)
    near[surface.faces[folded].ravel()] = True
    share = near.astype(np.float64)
    for ring in range(rings + 1):
        near |= links @ near.astype(np.float64) > 0
        share = np.maximum(share, np.where(near, 1.0 - ring / (rings + 1), 0.0))
    inside = diags(near.astype(np.float64))
    return share, np.asarray(connected_components(inside @ links @ inside, directed=False)[1], dtype=np.int64)


def adjacency(surface: Surface) -> csr_matrix:
    """(V, V) 1 for each pair of vertices with an edge between them."""
    f, n = surface.faces, len(surface.vertices_m)
    begun = np.zeros(n + 1, dtype=np.int64)
    for k in range(3):
        np.add.at(begun, f[:, k] + 1, 2)  # each face gives each of its corners two neighbours
    np.cumsum(begun, out=begun)
    neighbours = np.empty(int(begun[-1]), dtype=np.int32)
    filled = begun[:-1].copy()
    for begin in range(0, len(f), _FACES):
        part = f[begin : begin + _FACES]
        one = np.concatenate([part[:, [0, 1, 2]].ravel(), part[:, [0, 1, 2]].ravel()])
        other = np.concatenate([part[:, [1, 2, 0]].ravel(), part[:, [2, 0, 1]].ravel()])
        order = np.argsort(one, kind="stable")
        one, other = one[order], other[order]
        vertex, start, count = np.unique(one, return_index=True, return_counts=True)
        neighbours[filled[one] + np.arange(len(one)) - np.repeat(start, count)] = other
        filled[vertex] += count
    links = csr_matrix((np.ones(len(neighbours), dtype=np.float32), neighbours, begun.astype(np.int32)), shape=(n, n))
    links.sum_duplicates()  # an edge of two faces is there twice
    return csr_matrix((np.ones(links.nnz), links.indices, links.indptr), shape=(n, n))


def _usual_edge(surface: Surface) -> float:
    lengths = np.empty(len(surface.faces))
    for block in surface.blocks():
        ends = surface.vertices_m[surface.faces[block, :2]]
        lengths[block] = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    return float(np.median(lengths))


def _folded(surface: Surface, points_m: Array, of: IntArray) -> IntArray:
    """Those of some faces whose normal turns by more than a right angle when the vertices move to these points."""
    moved = Surface(points_m, surface.faces)
    folded = np.empty(len(of), dtype=np.bool_)
    for begin in range(0, len(of), FACES):
        part = slice(begin, begin + FACES)
        after, before = moved.area_vectors_of(of[part]), surface.area_vectors_of(of[part])
        folded[part] = np.einsum("fi,fi->f", after, before) < 0
    return of[folded]
