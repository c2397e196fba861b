"""The step at the seam of a fused mesh: the difference of level between its two sides, with its standard error.

At a place on the seam, the errors h of the vertices within a radius r are fitted on both sides at once,

    h = a + J·[scan's side] + b₁·d on one side, b₂·d on the other + c·s,

where d is the distance from the seam, s the way along it, and a vertex weighs 1 − |d|/r. J is the step: what is left
between the sides at the seam when each may have a slope of its own (regression discontinuity; G. Imbens, T. Lemieux,
Regression discontinuity designs: a guide to practice, 2008). Neighbouring vertices share the noise of one face of
the scan, so the standard error of J is computed with the correlation over distance that the residuals of all places
have, and the variance that those of the place have. Whether it is right can be tried where no seam is, in the scan's
own part: there, J / its standard error has a spread of 1.

Plainer, and without a fit, is the difference between the mean errors of two strips, 0.5 mm wide, on both sides of the
seam (`strips`). The noise of scan and CT is in it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from service.compute.surfaces.overlap import Mask, distance_to
from service.compute.surfaces.surface import IntArray
from service.core.geometry import Array
from service.core.units import mm

BIN_M, _BINS = 2.5e-4, 6  # of the correlation over distance
_FOR_CORRELATION = 200  # places
_FITTED = 5  # parameters
_PLACES = 1000
_FEWEST = 20  # vertices on each side
_ALIKE = 0.7  # least cosine to the place's normal: others are another surface
_BOUND = 2.576  # standard errors, 99 %
_HALF = 0.05  # of the weight, about one half: such vertices are on the seam
_STRIP_M, _FEWEST_OF_STRIP = 5e-4, 5
_BESIDE_M = 3e-3  # distance from the overlap of the line for comparison, where there is no seam
_ON_M = 5e-5  # vertices nearer to that line are on it


@dataclass(frozen=True, slots=True)
class Line:
    """A line on a mesh: the vertices (K,) on it, and (N,) the signed distance of each vertex from it."""

    vertices: IntArray
    away_m: Array

    @property
    def places(self) -> IntArray:
        """Vertices on the line at which steps are measured."""
        return self.vertices[:: max(1, len(self.vertices) // _PLACES)]


def seam(points: Array, weight: Array, within_m: float) -> Line:
    """Where CT and scan count alike, from the weights (N,) of the scan at points (N, 3); the scan's side is above."""
    return _line(points, np.abs(weight - 0.5) < _HALF, weight > 0.5, within_m)


def no_seam(points: Array, weight: Array, within_m: float) -> Line:
    """A line in the scan's own part, away from the overlap: what is found there is noise of the scan."""
    away = distance_to(points, weight < 1, np.inf)
    return _line(points, np.abs(away - _BESIDE_M) < _ON_M, away > _BESIDE_M, within_m)


def _line(points: Array, on: Mask, above: Mask, within_m: float) -> Line:
    return Line(np.flatnonzero(on), np.where(above, 1.0, -1.0) * distance_to(points, on, within_m))


def strips(points: Array, height: Array, line: Line, radius_m: float) -> dict[str, float]:
    """Millimetres: differences between the mean errors of both strips within a radius of places on the line."""
    chosen = np.flatnonzero(np.abs(line.away_m) < _STRIP_M)
    above, error = line.away_m[chosen] > 0, height[chosen]
    found: list[float] = []
    for near in cKDTree(points[chosen]).query_ball_point(points[line.places], radius_m):
        side = above[near]
        if min(side.sum(), (~side).sum()) >= _FEWEST_OF_STRIP:
            found.append(abs(float(error[near][side].mean() - error[near][~side].mean())))
    sizes = {"median": float(np.median(found)), "p99": float(np.percentile(found, 99)), "max": max(found)}
    return {"places": len(found), **_in_mm(sizes)}


def _in_mm(metres: Mapping[str, float]) -> dict[str, float]:
    return {name: round(mm(float(value)), 4) for name, value in metres.items()}


@dataclass(frozen=True, slots=True)
class Steps:
    """Steps (P,) at places of a seam, and their standard errors (P,), in metres."""

    step_m: Array
    error_m: Array

    def told(self) -> dict[str, float]:
        """Figures in millimetres: sizes, and the largest that is proven, the lower bound (99 %) of a size.

        `spread` is that of the steps in standard errors: 1 if they are noise alone.
        """
        size = np.abs(self.step_m)
        sizes = {"median": float(np.median(size)), "p99": float(np.percentile(size, 99)), "max": float(size.max())}
        proven = np.maximum(size - _BOUND * self.error_m, 0.0)
        sizes |= {"standard_error": float(np.median(self.error_m)), "most_proven": float(proven.max())}
        spread = float(np.sqrt(np.mean((self.step_m / self.error_m) ** 2)))
        return {"places": len(size), "spread": round(spread, 2), **_in_mm(sizes)}


def steps(points: Array, normals: Array, height: Array, line: Line, radius_m: float) -> Steps:
    """Fit the errors (N,) of points (N, 3) with normals (N, 3) on both sides of the line, at places along it."""
    near_line = np.flatnonzero(np.abs(line.away_m) < radius_m)
    index, on_line = cKDTree(points[near_line]), cKDTree(points[line.vertices])
    fits: list[_Fit] = []
    for place in line.places:
        near = near_line[index.query_ball_point(points[place], radius_m)]
        near = near[normals[near] @ normals[place] > _ALIKE]
        along = _direction(points[line.vertices[on_line.query_ball_point(points[place], radius_m)]])
        if (fit := _fitted(points[near], height[near], line.away_m[near], along, radius_m)) is not None:
            fits.append(fit)
    correlation = _correlation(fits)
    return Steps(np.array([f.step_m for f in fits]), np.array([f.standard_error(correlation) for f in fits]))


@dataclass(frozen=True, slots=True)
class _Fit:
    """A step; its derivatives (N,) by the errors of the points (N, 3); and what the fit leaves of them (N,)."""

    step_m: float
    by_height: Array
    points: Array
    left_m: Array

    def standard_error(self, correlation: Array) -> float:
        """Of the step, if the noise has this correlation (B,) over distance, in bins of BIN_M."""
        C = correlation[_bins(self.points)]
        free = float(np.trace(C) - _FITTED)
        variance = float(self.left_m @ self.left_m) / max(free, 1.0)
        return float(np.sqrt(max(variance * self.by_height @ C @ self.by_height, 0.0)))


def _bins(points: Array) -> IntArray:
    """(N, N) bin of the distance between points (N, 3)."""
    return np.minimum(np.rint(cdist(points, points) / BIN_M), _BINS).astype(np.int64)


def _correlation(fits: list[_Fit]) -> Array:
    """(B + 1,) of what the fits leave, over distance; 0 in the last bin, of all that is farther."""
    total, count = np.zeros(_BINS + 1), np.zeros(_BINS + 1)
    for fit in fits[:: max(1, len(fits) // _FOR_CORRELATION)]:
        which = _bins(fit.points).ravel()
        total += np.bincount(which, np.outer(fit.left_m, fit.left_m).ravel(), _BINS + 1)
        count += np.bincount(which, minlength=_BINS + 1)
    out = total / np.maximum(count, 1) / (total[0] / count[0])
    out[-1] = 0.0
    return out


def _direction(line: Array) -> Array:
    """(3,) along a line's points (K, 3)."""
    return np.linalg.svd(line - line.mean(axis=0), full_matrices=False)[2][0]


def _fitted(points: Array, height: Array, away: Array, along: Array, radius_m: float) -> _Fit | None:
    """The fit about a place; None if one side has too few vertices."""
    above = away > 0
    if min(above.sum(), (~above).sum()) < _FEWEST:
        return None
    weight = 1 - np.abs(away) / radius_m
    d, s = away / radius_m, (points - points.mean(axis=0)) @ along / radius_m
    X = np.stack([np.ones(len(d)), above.astype(np.float64), np.where(above, 0, d), np.where(above, d, 0), s], axis=1)
    A = np.linalg.pinv(X.T @ (weight[:, None] * X)) @ (X.T * weight)
    a = A @ height
    return _Fit(float(a[1]), A[1], points, height - X @ a)
