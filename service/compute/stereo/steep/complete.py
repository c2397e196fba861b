"""Completes a fused surface where it is open and steep: a closed guess is moved until the photographs are alike.

Rectified matching loses what is steep: it is foreshortened, each pair of images differently. Here patches lie in the
surface. Where to move each vertex of the guess is chosen for all vertices together. Those with little evidence keep
the shape of the guess in that, and are bent to those with much. What the photographs do not support is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from service.compute.ground_truth.distances.neighbours import PointIndex
from service.compute.ground_truth.surface import Surface
from service.compute.pixels.ray_mesh import RayMesh
from service.compute.stereo.closed import closed
from service.compute.stereo.pairs import StereoView
from service.compute.stereo.steep.choice import averaged, beliefs, edges_of
from service.compute.stereo.steep.evidence import Photograph, best_views, evidence, photograph, seen_through
from service.compute.stereo.steep.relaxed import relaxed
from service.core.geometry import Array

# What follows is in pixels of the images, at the object.
_OPEN_PX = 2.5  # from the surface that is known: farther vertices of the guess are moved
_SEARCHES = ((16.0, 1.0, 2.5), (12.0, 1.0, 2.0))  # reach to both sides, step, spacing of a patch's samples
_SMOOTH_PX, _SLIP_PX = 6.0, 1.0  # length over which the moved surface is made even, and change that evidence permits
_RING = 3  # edges: vertices of the known surface around an opening, which stay
_EVEN = 8  # means of normals with their neighbours'
_PER_STEP, _MOST = 0.06, 0.48  # cost of neighbours that move differently, by a step and by many
_THROUGH, _MOST_THROUGH = 0.15, 6  # cost of each view that sees through a place, up to so many
_STAYS, _MOST_STAYS = 0.5, 3.0  # cost of a known vertex that moves, by a step and by many
_NO_HOLD, _FULL_HOLD = 0.4, 0.8  # evidence up to which a vertex is not held in place then, and from which it is fully
_LEAST_EVIDENCE = 0.2  # of a place that is kept
_STEEP = 0.6  # cosine at the second view: what two views see less steeply, rectified matching would have found
_FEW_THROUGH = 2  # views that see through a place that is not kept
_FIELD = 0.5  # of the views, that have a place in their image: the object, not the room

Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class _Opening:
    """The part of the guess that is moved: vertices by index, edges between them, and which of them stay."""

    vertices: Ints = field(repr=False)
    edges: Ints = field(repr=False)
    stays: NDArray[np.bool_] = field(repr=False)


def completed(known: Surface, views: Sequence[StereoView], footprint_m: float) -> Surface:
    """The surface with what it lacks where it is steep, as further faces that do not share its vertices.

    Args:
        known: the fused surface.
        views: that it was made from.
        footprint_m: what a pixel of them covers at the object.
    """
    guess = closed(known)
    seen = RayMesh(known.vertices_m, known.faces)
    photographs = [photograph(view, seen) for view in views]
    edges = edges_of(guess.faces)
    part = _opening(known, guess, edges, photographs, _OPEN_PX * footprint_m)
    if part.stays.all():
        return known
    vertices, places, normals, found = guess.vertices_m.copy(), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    for reach, step, spacing in _SEARCHES:
        even = averaged(Surface(vertices, guess.faces).vertex_normals, edges, _EVEN)
        normals = even[part.vertices] / np.maximum(np.linalg.norm(even[part.vertices], axis=1, keepdims=True), 1e-9)
        moves = np.arange(-reach, reach + step / 2, step) * footprint_m
        moved, found = _moved(photographs, vertices[part.vertices], normals, part, moves, spacing * footprint_m)
        places = vertices[part.vertices] + moved[:, None] * normals
        held = ((found - _NO_HOLD) / (_FULL_HOLD - _NO_HOLD)).clip(0, 1) ** 2
        even_m, slip_m = _SMOOTH_PX * footprint_m, _SLIP_PX * footprint_m
        vertices[part.vertices] = relaxed(places, held, part.stays, part.edges, even_m, slip_m)
    kept = _supported(photographs, places, normals, found) & ~part.stays
    return _with(known, vertices, guess.faces, part, kept)


def _opening(
    known: Surface, guess: Surface, edges: Ints, photographs: Sequence[Photograph], far_m: float
) -> _Opening:
    """Vertices of the guess far from the known surface, and a ring of others around them."""
    is_open = ~np.isfinite(PointIndex(known.vertices_m).nearest(guess.vertices_m, far_m)[0])
    within = np.sum([one.seen(guess.vertices_m)[3] for one in photographs], axis=0)
    is_open &= within >= _FIELD * len(photographs)
    taken = is_open.copy()
    for _ in range(_RING):
        touched = taken[edges].any(axis=1)
        taken[edges[touched].ravel()] = True
    vertices = np.flatnonzero(taken)
    compact = np.full(len(taken), -1, dtype=np.int64)
    compact[vertices] = np.arange(len(vertices))
    return _Opening(vertices, compact[edges[taken[edges].all(axis=1)]], ~is_open[vertices])


def _moved(
    photographs: Sequence[Photograph],
    points_m: Array,
    normals: Array,
    part: _Opening,
    moves_m: Array,
    spacing_m: float,
) -> tuple[Array, Array]:
    """(N,) metres that each vertex is to move along its normal, and the evidence for it."""
    alike = averaged(evidence(photographs, points_m, normals, moves_m, spacing_m)[0], part.edges, 1)
    places = points_m[:, None] + moves_m[:, None] * normals[:, None]
    costs = 1 - alike + _THROUGH * np.minimum(seen_through(photographs, places), _MOST_THROUGH)
    steps = np.abs(np.arange(len(moves_m)) - len(moves_m) // 2)
    costs[part.stays] = np.minimum(_STAYS * steps, _MOST_STAYS)
    belief = beliefs(costs.astype(np.float32), part.edges, _PER_STEP, _MOST)
    best = belief.argmin(axis=1)
    moved = np.where(part.stays, 0.0, _lowest(belief, best, moves_m))
    moved = np.where(part.stays, 0.0, averaged(moved, part.edges, 1))
    return moved, alike[np.arange(len(best)), best]


def _lowest(belief: NDArray[np.float32], best: Ints, moves_m: Array) -> Array:
    """(N,) the move at the minimum of the parabola through the best label and its neighbours."""
    row, inner = np.arange(len(best)), best.clip(1, len(moves_m) - 2)
    before, at, after = (belief[row, inner + k].astype(np.float64) for k in (-1, 0, 1))
    curvature = before - 2 * at + after
    shift = np.where(curvature > 1e-5, 0.5 * (before - after) / np.maximum(curvature, 1e-5), 0.0)
    shift = np.where(best == inner, shift.clip(-1, 1), 0.0)
    return moves_m[best] + shift * (moves_m[1] - moves_m[0])


def _supported(photographs: Sequence[Photograph], points_m: Array, normals: Array, found: Array) -> NDArray[np.bool_]:
    """Which vertices are steep, have evidence, and are not seen through."""
    second = best_views(photographs, points_m, normals)[1][:, 1]
    return (
        (second > 0)
        & (second < _STEEP)
        & (found > _LEAST_EVIDENCE)
        & (seen_through(photographs, points_m) < _FEW_THROUGH)
    )


def _with(known: Surface, vertices_m: Array, faces: Ints, part: _Opening, kept: NDArray[np.bool_]) -> Surface:
    """The known surface and the faces that have a kept vertex, and else only known ones."""
    is_kept, usable = (np.zeros(len(vertices_m), dtype=np.bool_) for _ in range(2))
    is_kept[part.vertices[kept]] = True
    usable[part.vertices[kept | part.stays]] = True
    added = faces[is_kept[faces].any(axis=1) & usable[faces].all(axis=1)]
    used, compact = np.unique(added, return_inverse=True)
    return Surface(
        np.concatenate([known.vertices_m, vertices_m[used]]),
        np.concatenate([known.faces, compact.reshape(-1, 3) + len(known.vertices_m)]).astype(np.int64),
    )
