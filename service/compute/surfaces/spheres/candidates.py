"""Candidate spheres of a given radius: surfels vote for centres, and a coarse fit filters the candidates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from service.compute.surfaces.spheres.tukey import Band, OrientedPoints, TukeyStep, fit_centre
from service.compute.surfaces.surfels import Surfels, grid_keys, summed
from service.core.geometry import Array

IntArray = NDArray[np.int64]

_VOTE = 1 / 6  # cell of the voting grid, in radii
_MIN_VOTE = 0.025  # votes a candidate needs, as a fraction of the whole sphere
_MAX_CANDIDATES = 600
_APART = 0.4  # of candidates, in radii
_HOOD = 1.35  # radius around a candidate in which the sphere's surface is searched for, in radii
_MIN_COSINE = 0.7  # between normal and radius; below it, a surfel is not on the sphere
_MIN_SURFELS = 5  # of a fit
_STEPS = 15
_BAND = 0.05  # of the coarse fit, in radii; surfels have little noise left
_FLANK = 0.12  # in radii beyond that, where another shape would continue smoothly
_FLANK_COSINE = 0.88
_ROUGH_RMS = 0.013  # of the coarse fit, in radii
_WELL_COVERED = 0.3  # above it, fitted whatever its rms, so that the operator is told why it is refused
_MOST_FLANK = 0.6  # area of the flank over that of the inliers


def candidates(patches: Surfels, tree: cKDTree, radius: float, min_coverage: float) -> Array:
    """Centres (K, 3) around which the surface is roughly a sphere over at least `min_coverage` of it."""
    found: list[Array] = []
    for peak in vote_peaks(patches, radius):
        centre = rough_centre(patches, tree, peak, radius, min_coverage)
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
    for offset in (int((i * size[1] + j) * size[2] + k) for i in steps for j in steps for k in steps):
        if offset == 0:
            continue
        at = np.searchsorted(cells, cells + offset)
        at[at == len(cells)] = 0
        hit = cells[at] == cells + offset
        total[hit] += mass[at[hit]]
        centre[hit] += moment[at[hit]]
    strong = np.flatnonzero(total > _MIN_VOTE * 4 * np.pi * radius**2)
    strong = strong[np.argsort(-total[strong], kind="stable")]
    peaks = centre[strong] / total[strong, None]
    picked: list[Array] = []
    free = np.ones(len(peaks), dtype=bool)
    for k, peak in enumerate(peaks):
        if not free[k]:
            continue
        picked.append(peak)
        if len(picked) == _MAX_CANDIDATES:
            break
        free[k:] &= np.linalg.norm(peaks[k:] - peak, axis=1) > _APART * radius
    return np.array(picked).reshape(-1, 3)


def rough_centre(patches: Surfels, tree: cKDTree, start: Array, radius: float, min_coverage: float) -> Array | None:
    """Known-radius fit to the surfels near `start`, as a centre (3,); None if they are not a sphere."""
    hood = np.asarray(tree.query_ball_point(start, _HOOD * radius), dtype=np.int64)
    if len(hood) < _MIN_SURFELS:
        return None
    points, normals, area = patches.position[hood], patches.normal[hood], patches.area[hood]

    def narrowed(at: TukeyStep, half_width: float) -> float | None:
        if np.linalg.norm(at.step) < 1e-4 * radius and half_width <= 1.001 * _BAND * radius:
            return None
        return max(_BAND * radius, 0.7 * half_width)

    first = Band(0.3 * radius, _MIN_COSINE, _MIN_SURFELS)
    fitted = fit_centre(
        OrientedPoints(points, normals, area), start, radius, first, narrowed, reach=radius, most=_STEPS
    )
    if fitted is None:
        return None
    centre, band, at = fitted.centre, fitted.half_width, fitted.last
    residual, weights = at.residual, at.weights
    inlier = weights > 0
    coverage = float(np.sum(area[inlier])) / (4 * np.pi * radius**2)
    beyond = (np.abs(residual) >= band) & (np.abs(residual) < band + _FLANK * radius)
    beyond &= at.cosine > _FLANK_COSINE
    rms = float(np.sqrt(np.sum(weights * residual**2) / np.sum(weights)))
    ends = float(np.sum(area[beyond])) <= _MOST_FLANK * float(np.sum(area[inlier]))
    round_enough = rms <= _ROUGH_RMS * radius or coverage >= _WELL_COVERED
    return centre if coverage >= 0.6 * min_coverage and ends and round_enough else None
