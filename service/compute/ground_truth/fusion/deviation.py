"""The deviation of a CT from a scan as a smooth field, which goes on into the parts that the scan does not show.

A CT deviates from the true surface by up to some tenths of a millimetre where the material changes (bone, steel) and
where the surface is curved. Without this field, that deviation would be a step at the seam.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.linalg import cg

from service.compute.ground_truth.fusion.overlap import Mask
from service.compute.ground_truth.surface import IntArray, Surface
from service.core.errors import ComputeError
from service.core.geometry import Array

_ITERATIONS, _RELATIVE = 2000, 1e-3
_AVERAGED = 4  # times in each attempt
_ALIKE = (1, 1, 2)  # rings of neighbours around faces that turn over: in them, moves become alike
_ROUNDED = (0,) * 10  # then their own corners are evened out


@dataclass(frozen=True, slots=True)
class FieldLengths:
    """How smooth the field is.

    Attributes:
        smoothing_m: over which the field averages the scan's noise.
        reach_m: over which it decays where the scan shows nothing.
    """

    smoothing_m: float = 0.0007
    reach_m: float = 0.006


def deviation_field(surface: Surface, known_m: Array, known: Mask, lengths: FieldLengths) -> Array:
    """(V,) metres: follows `known_m` where it is `known`, and decays from there along the surface.

    It minimises the squared differences over the edges, with weights towards the known values and, elsewhere, 0.

    Args:
        surface: a mesh.
        known_m: (V,) deviations, along the normals.
        known: (V,) where they count.
        lengths: of smoothing and decay.

    Raises:
        ComputeError: the solver does not converge.
    """
    links = adjacency(surface)
    edge_m = _usual_edge(surface)
    pull = np.where(known, (edge_m / lengths.smoothing_m) ** 2, (edge_m / lengths.reach_m) ** 2)
    diagonal = np.asarray(links.sum(axis=1)).ravel() + pull
    matrix = (diags(diagonal) - links).tocsr()
    wanted = np.where(known, pull * known_m, 0.0)
    field, left = cg(matrix, wanted, rtol=_RELATIVE, maxiter=_ITERATIONS, M=diags(1 / diagonal))
    if left != 0:
        raise ComputeError("the deviation of the CT from the scan has no smooth field", remedy="Check both meshes")
    return np.asarray(field, dtype=np.float64)


def moved_unfolded(surface: Surface, move_m: Array) -> tuple[Surface, int]:
    """The surface after a displacement (V, 3) of its vertices, and the number of faces that are turned over.

    Around faces that turn over (mostly slivers of marching cubes), displacements are averaged with those of their
    neighbours: equal displacements turn no face. Where that is not enough, vertices move to the mean of their
    neighbours.
    """
    points = surface.vertices_m + move_m
    folded = _folded(surface, points)
    if not len(folded):
        return Surface(points, surface.faces), 0
    links = adjacency(surface)
    means: csr_matrix = (diags(1 / np.maximum(np.asarray(links.sum(axis=1)).ravel(), 1.0)) @ links).tocsr()
    for rings in (*_ALIKE, *_ROUNDED):
        around = np.zeros(len(points))
        around[surface.faces[folded].ravel()] = 1.0
        for _ in range(rings):
            around += links @ around
        chosen = np.flatnonzero(around)
        fixed = surface.vertices_m if rings else np.zeros_like(points)
        for _ in range(_AVERAGED):
            move = points - fixed
            points[chosen] = fixed[chosen] + 0.5 * (move[chosen] + means[chosen] @ move)
        folded = _folded(surface, points)
        if not len(folded):
            break
    return Surface(points, surface.faces), len(folded)


def adjacency(surface: Surface) -> csr_matrix:
    """(V, V) 1 for each pair of vertices with an edge between them."""
    f, n = surface.faces, len(surface.vertices_m)
    ends = np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]])
    ends = np.concatenate([ends, ends[:, ::-1]])
    links = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(n, n)).tocsr()
    links.data[:] = 1.0  # an edge of two faces was counted twice
    return links


def _usual_edge(surface: Surface) -> float:
    ends = surface.vertices_m[surface.faces[:, :2]]
    return float(np.median(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)))


def _folded(surface: Surface, points_m: Array) -> IntArray:
    """Indices of the faces whose normal turns by more than a right angle when the vertices move to these points."""
    moved = Surface(points_m, surface.faces)
    return np.flatnonzero(np.einsum("fi,fi->f", moved.area_vectors_m2, surface.area_vectors_m2) < 0)
