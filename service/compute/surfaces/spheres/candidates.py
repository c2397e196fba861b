"""Candidate spheres of a given radius: surfels vote for centres, and coarse fits filter the candidates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from service.compute.surfaces.spheres.rough_fits import rough_centres
from service.compute.surfaces.surfels import Surfels, grid_keys, summed
from service.core.geometry import Array

IntArray = NDArray[np.int64]

_VOTE = 1 / 6  # cell of the voting grid, in radii
_MIN_VOTE = 0.025  # votes a candidate needs, as a fraction of the whole sphere
_MAX_CANDIDATES = 600
_APART = 0.4  # of candidates, in radii


def candidates(patches: Surfels, tree: cKDTree, radius: float, min_coverage: float) -> Array:
    """Centres (K, 3) around which the surface is roughly a sphere over at least `min_coverage` of it."""
    found: list[Array] = []
    for centre in rough_centres(patches, tree, vote_peaks(patches, radius), radius, min_coverage):
        if centre is not None and all(np.linalg.norm(centre - c) > 0.05 * radius for c in found):
            found.append(centre)
    return np.array(found).reshape(-1, 3)


def vote_peaks(patches: Surfels, radius: float) -> Array:
    """Candidate centres (K, 3), strongest first; every surfel votes on both of its sides."""
    votes = np.concatenate([patches.position - radius * patches.normal, patches.position + radius * patches.normal])
    if len(votes) == 0:
        return np.empty((0, 3))
    weight = np.concatenate([patches.area, patches.area])
    cell = _VOTE * radius
    low = votes.min(axis=0)
    size = np.floor((votes.max(axis=0) - low) / cell).astype(np.int64) + 3
    cells, group = np.unique(grid_keys(votes, low, size, cell), return_inverse=True)
    sums = summed(group, [weight, *(votes.T * weight)], len(cells))
    mass, moment = sums[:, 0], sums[:, 1:]
    total, centre = mass.copy(), moment.copy()
    steps = (-1, 0, 1)
    for row in (int((i * size[1] + j) * size[2]) for i in steps for j in steps):
        # The keys of a row's three cells follow one another, so that one search finds all of them.
        at = np.searchsorted(cells, cells + (row - 1))
        for offset in (row - 1, row, row + 1):
            hit = np.flatnonzero(cells[np.minimum(at, len(cells) - 1)] == cells + offset)
            if offset != 0:
                total[hit] += mass[at[hit]]
                centre[hit] += moment[at[hit]]
            at[hit] += 1
    strong = np.flatnonzero(total > _MIN_VOTE * 4 * np.pi * radius**2)
    strong = strong[np.argsort(-total[strong], kind="stable")]
    peaks = centre[strong] / total[strong, None]
    around = cKDTree(peaks)
    picked: list[Array] = []
    free = np.ones(len(peaks), dtype=bool)
    for k, peak in enumerate(peaks):
        if not free[k]:
            continue
        picked.append(peak)
        if len(picked) == _MAX_CANDIDATES:
            break
        near = np.array(around.query_ball_point(peak, 1.001 * _APART * radius))
        free[near] &= np.linalg.norm(peaks[near] - peak, axis=1) > _APART * radius
    return np.array(picked).reshape(-1, 3)
