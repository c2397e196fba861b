"""The robust fit of a sphere of known radius to points, with Tukey's weights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from service.core.geometry import Array

# Of the directions: least eigenvalue over the trace; below it, a cap is too flat to fix the centre.
LEAST_SPREAD = 1e-3


@dataclass(frozen=True, slots=True)
class Band:
    """Which samples have a weight in a fit.

    Attributes:
        half_width: residual beyond which a sample has no weight, m.
        min_cosine: between normal and radius; below it, a sample is not on the sphere.
        min_samples: below it, there is no fit.
    """

    half_width: float
    min_cosine: float
    min_samples: int


@dataclass(frozen=True, slots=True)
class TukeyStep:
    """Residuals and weights at a centre, and the step from it.

    Attributes:
        unit: (N, 3) directions from the centre to the samples.
        residual: (N,) distances from the sphere, m, outward positive.
        cosine: (N,) between normal and radius, without sign.
        eligible: (N,) whether a sample lies in the band.
        weights: (N,) Tukey's weights times the samples' areas.
        step: (3,) of the centre, m.
    """

    unit: Array
    residual: Array
    cosine: Array
    eligible: NDArray[np.bool_]
    weights: Array
    step: Array


@dataclass(frozen=True, slots=True)
class OrientedPoints:
    """Samples of a surface with their normals.

    Attributes:
        points: (N, 3), m.
        normals: (N, 3) unit, of either sign.
        area: (N,) that each sample represents.
    """

    points: Array
    normals: Array
    area: Array


@dataclass(frozen=True, slots=True)
class CentreFit:
    """A fitted centre (3,) in m, the final half-width of the band in m, and the last step."""

    centre: Array
    half_width: float
    last: TukeyStep


def tukey_weights(residual: Array, half_width: float | Array) -> Array:
    """Tukey's weights (N,) of residuals (N,) that lie in a band of this half-width (N,)."""
    return (1 - (residual / half_width) ** 2) ** 2


def fit_centre(
    surface: OrientedPoints,
    start: Array,
    radius: float,
    band: Band,
    narrowed: Callable[[TukeyStep, float], float | None],
    *,
    reach: float,
    most: int,
) -> CentreFit | None:
    """The centre of a sphere; None if its surface is not there, or the centre moves beyond `reach`.

    It is a reweighted fit, not least squares of a fixed cost: the band shrinks with the residuals until both settle.

    Args:
        surface: samples near the sphere.
        start: (3,) initial centre, m.
        radius: of the sphere, m.
        band: which samples count at first.
        narrowed: the next half-width after a step, from the step and the present half-width; None: it has settled.
        reach: largest distance of the centre from the start, m.
        most: largest number of steps.
    """
    centre, at = start.copy(), _step(surface, start, radius, band)
    for taken in range(1, most + 1):
        if at is None:
            return None
        centre = centre + at.step
        if np.linalg.norm(centre - start) > reach:
            return None
        half_width = narrowed(at, band.half_width)
        band = band if half_width is None else replace(band, half_width=half_width)
        if half_width is None or taken == most:
            return CentreFit(centre, band.half_width, at)
        at = _step(surface, centre, radius, band)
    return None


def _step(surface: OrientedPoints, centre: Array, radius: float, band: Band) -> TukeyStep | None:
    """Weighted Gauss–Newton step of the centre; None if too few samples lie in the band, or in too flat a cap."""
    ray = surface.points - centre
    distance = np.sqrt(np.einsum("ij,ij->i", ray, ray))
    unit = ray / np.maximum(distance, 1e-300)[:, None]
    residual = distance - radius
    cosine = np.abs(np.einsum("ij,ij->i", unit, surface.normals))
    eligible = (np.abs(residual) < band.half_width) & (cosine > band.min_cosine)
    if np.count_nonzero(eligible) < band.min_samples:
        return None
    weights = np.where(eligible, tukey_weights(residual, band.half_width), 0.0) * surface.area
    weighted = unit * weights[:, None]
    H = weighted.T @ unit
    if np.linalg.eigvalsh(H)[0] < LEAST_SPREAD * np.trace(H):
        return None
    return TukeyStep(unit, residual, cosine, eligible, weights, np.linalg.solve(H, weighted.T @ residual))
