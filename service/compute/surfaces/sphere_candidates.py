"""Finds candidate spheres of a known radius: surfels vote for centres, and coarse fits filter the candidates."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from service.compute.surfaces.sphere_fit import LEAST_SPREAD, Surfels, grid_keys, summed, tukey_weights
from service.core.geometry import Array

IntArray = NDArray[np.int64]

_VOTE = 1 / 6  # cell of the voting grid, in radii
_MIN_VOTE = 0.025  # votes a candidate needs, as a fraction of the whole sphere
_MAX_CANDIDATES = 600
_APART = 0.4  # of candidates, in radii


def candidates(patches: Surfels, tree: cKDTree, radius: float, min_coverage: float) -> Array:
    """Return the centres (K, 3) around which the surface is roughly a sphere over at least `min_coverage` of it."""
    found: list[Array] = []
    for centre in rough_centres(patches, tree, vote_peaks(patches, radius), radius, min_coverage):
        if centre is not None and all(np.linalg.norm(centre - c) > 0.05 * radius for c in found):
            found.append(centre)
    return np.array(found).reshape(-1, 3)


def vote_peaks(patches: Surfels, radius: float) -> Array:
    """Return the candidate centres (K, 3), strongest first; every surfel votes on both of its sides."""
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


_HOOD = 1.35  # radius around a place in which the sphere's surface is searched for, in radii
_MIN_COSINE = 0.7  # between normal and radius; below it, a surfel is not on the sphere
_MIN_SURFELS = 5  # of a fit
_STEPS = 15
_FIRST_BAND, _BAND = 0.3, 0.05  # half-width of the first and of the last step, in radii
_NARROWING = 0.7  # of the half-width, from step to step
_SETTLED = 1e-4  # length of the last step, in radii
_FLANK = 0.12  # in radii beyond the band, where another shape would continue smoothly
_FLANK_COSINE = 0.88
_ROUGH_RMS = 0.013  # of the fit, in radii
_WELL_COVERED = 0.3  # above it, accepted whatever its rms, so that the operator learns why it is refused
_MOST_FLANK = 0.6  # area of the flank over that of the inliers


@dataclass(frozen=True, slots=True)
class _Fits:
    """The state of F fits and the S surfels around them, those of a fit in a row."""

    which: NDArray[np.int64]  # (F,) the place that each began at
    start: Array  # (F, 3)
    centre: Array  # (F, 3)
    half_width: Array  # (F,)
    first: NDArray[np.int64]  # (F,) index of its first surfel
    owner: NDArray[np.int64]  # (S,) its fit
    points: Array  # (S, 3)
    normals: Array  # (S, 3)
    area: Array  # (S,)

    def kept(self, keep: NDArray[np.bool_]) -> _Fits:
        """Return only some of the fits."""
        rows = keep[self.owner]
        counts = np.diff([*self.first, len(self.owner)])[keep]
        return _Fits(
            self.which[keep], self.start[keep], self.centre[keep], self.half_width[keep],
            np.cumsum(counts) - counts, np.repeat(np.arange(len(counts)), counts),
            self.points[rows], self.normals[rows], self.area[rows],
        )  # fmt: skip

    def summed(self, values: Array) -> Array:
        """Return (F, ...) sums of values (S, ...) over the surfels of each fit."""
        return np.add.reduceat(values, self.first, axis=0)


@dataclass(frozen=True, slots=True)
class _Step:
    """A weighted Gauss–Newton step of every fit."""

    residual: Array  # (S,)
    cosine: Array  # (S,)
    weights: Array  # (S,)
    possible: NDArray[np.bool_]  # (F,) enough surfels lie in the band, and not in too flat a cap
    step: Array  # (F, 3)


def rough_centres(
    patches: Surfels, tree: cKDTree, starts: Array, radius: float, min_coverage: float
) -> list[Array | None]:
    """Fit spheres of a known radius to the surfels near places (K, 3): a centre (3,) or None for each.

    Args:
        patches: the surface.
        tree: tree of the surfels' positions.
        starts: (K, 3) places at or near centres, m.
        radius: radius of the spheres, m.
        min_coverage: fraction of the whole sphere that will be required of the final fit.
    """
    found: list[Array | None] = [None] * len(starts)
    fits = _begin(patches, tree, starts, radius)
    for taken in range(1, _STEPS + 1):
        if len(fits.which) == 0:
            break
        step = _step(fits, radius)
        moved = fits.centre + step.step
        far = np.linalg.norm(moved - fits.start, axis=1) > radius
        settled = np.linalg.norm(step.step, axis=1) < _SETTLED * radius
        settled &= fits.half_width <= 1.001 * _BAND * radius
        ended = step.possible & ~far & (settled | (taken == _STEPS))
        is_sphere = ended & _is_sphere(fits, step, radius, min_coverage)
        for k in np.flatnonzero(is_sphere):
            found[int(fits.which[k])] = moved[k]
        narrower = np.maximum(_BAND * radius, _NARROWING * fits.half_width)
        fits = replace(fits, centre=moved, half_width=narrower).kept(step.possible & ~far & ~ended)
    return found


def _begin(patches: Surfels, tree: cKDTree, starts: Array, radius: float) -> _Fits:
    hoods = [np.asarray(near, dtype=np.int64) for near in tree.query_ball_point(starts, _HOOD * radius)]
    which = np.array([k for k, near in enumerate(hoods) if len(near) >= _MIN_SURFELS], dtype=np.int64)
    near = np.concatenate([np.empty(0, dtype=np.int64), *(hoods[k] for k in which)])
    counts = np.array([len(hoods[k]) for k in which], dtype=np.int64)
    return _Fits(
        which, starts[which], starts[which], np.full(len(which), _FIRST_BAND * radius),
        np.cumsum(counts) - counts, np.repeat(np.arange(len(which)), counts),
        patches.position[near], patches.normal[near], patches.area[near],
    )  # fmt: skip


def _step(fits: _Fits, radius: float) -> _Step:
    ray = fits.points - fits.centre[fits.owner]
    distance = np.sqrt(np.einsum("ij,ij->i", ray, ray))
    unit = ray / np.maximum(distance, 1e-300)[:, None]
    residual, half_width = distance - radius, fits.half_width[fits.owner]
    cosine = np.abs(np.einsum("ij,ij->i", unit, fits.normals))
    eligible = (np.abs(residual) < half_width) & (cosine > _MIN_COSINE)
    weights = np.where(eligible, tukey_weights(residual, half_width), 0.0) * fits.area
    weighted = unit * weights[:, None]
    H = fits.summed(weighted[:, :, None] * unit[:, None, :])
    possible = fits.summed(eligible.astype(np.int64)) >= _MIN_SURFELS
    possible &= np.linalg.eigvalsh(H)[:, 0] >= LEAST_SPREAD * np.trace(H, axis1=1, axis2=2)
    solvable = np.where(possible[:, None, None], H, np.eye(3))
    step = np.linalg.solve(solvable, fits.summed(weighted * residual[:, None])[:, :, None])[:, :, 0]
    return _Step(residual, cosine, weights, possible, np.where(possible[:, None], step, 0.0))


def _is_sphere(fits: _Fits, step: _Step, radius: float, min_coverage: float) -> NDArray[np.bool_]:
    """Return (F,) whether the surface covers enough of the sphere, is round, and ends with it."""
    inlier, distance, band = step.weights > 0, np.abs(step.residual), fits.half_width[fits.owner]
    beyond = (distance >= band) & (distance < band + _FLANK * radius) & (step.cosine > _FLANK_COSINE)
    area, flank = fits.summed(np.where(inlier, fits.area, 0.0)), fits.summed(np.where(beyond, fits.area, 0.0))
    total = np.maximum(fits.summed(step.weights), 1e-300)
    rms = np.sqrt(fits.summed(step.weights * step.residual**2) / total)
    coverage = area / (4 * np.pi * radius**2)
    round_enough = (rms <= _ROUGH_RMS * radius) | (coverage >= _WELL_COVERED)
    return (coverage >= 0.6 * min_coverage) & (flank <= _MOST_FLANK * area) & round_enough
