"""Robust fit of a sphere of known radius to mesh vertices or cloud points, with measures of its quality."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.compute.surfaces.spheres.tukey import Band, OrientedPoints, TukeyStep, fit_centre
from service.compute.surfaces.surfels import summed
from service.core.geometry import Array

IntArray = NDArray[np.int64]

MIN_SAMPLES = 12
_MIN_COSINE = 0.85  # between normal and radius; below it, a sample is not on the sphere
_FLANK = 0.12  # beyond the inliers, in radii, where a surface of another shape would continue
_FLANK_COSINE = 0.88
_PATCH = 0.27  # cell over which residuals are averaged, in radii
_MOST_PATCHES = 70
_STEPS = 40


@dataclass(frozen=True, slots=True)
class SphereSamples:
    """Points on the surface near one candidate.

    Vertices are measured, not facets: a facet with edge e on a sphere lies up to e²/(8 R) inside it, which would move
    a cap's centre by as much, while its vertices lie on the sphere.

    Attributes:
        points: (N, 3).
        normals: (N, 3) unit, of either sign, averaged over the neighbourhood.
        outward: (N, 3) normals stated by the data (0 if none), averaged over the neighbourhood.
        weight: (N,) area that each point represents; relative for points without faces.
    """

    points: Array
    normals: Array
    outward: Array
    weight: Array


@dataclass(frozen=True, slots=True)
class Patches:
    """Residuals of one fit, averaged over cells of surface, as input of the noise model.

    Attributes:
        unit: (P, 3) directions from the centre.
        residual: (P,) distance from the surface, m, outward positive, corrected for the attenuation by Tukey's
            weights.
        weight: (P,) sums of the samples' weights.
        white: (P,) variance of the average for independent samples of unit variance.
    """

    unit: Array
    residual: Array
    weight: Array
    white: Array


@dataclass(frozen=True, slots=True)
class SphereFit:
    """A finished fit.

    Attributes:
        centre: (3,), m.
        rms: weighted root mean square distance of the inliers, m.
        radius_residual: radius of a free fit minus the known one, m; NaN if the inliers do not determine it.
        coverage: solid angle of the inliers, as a fraction of the whole sphere.
        orientation: 1 if the stated normals point away from the centre, -1 if towards it, 0 if they disagree or there
            are none.
        flank: area of the surface that continues smoothly beyond the inliers, over their area: a sphere's surface
            ends or meets something at an angle.
        form: rms of the averaged residuals from a free sphere, m: deviation from a sphere's shape.
        n: number of inliers.
        patches: averaged residuals.
    """

    centre: Array
    rms: float
    radius_residual: float
    coverage: float
    orientation: float
    flank: float
    form: float
    n: int
    patches: Patches


def fit_sphere(samples: SphereSamples, start: Array, radius: float, band: float) -> SphereFit | None:
    """Tukey fit with known radius from a centre that is good to `band`; None if too few inliers remain."""
    points, area = samples.points, samples.weight

    def narrowed(at: TukeyStep, half_width: float) -> float | None:
        # Tukey's constant for 95 % efficiency; the floor keeps a perfect mesh from losing its vertices.
        spread = 1.4826 * float(np.median(np.abs(at.residual[at.eligible])))
        target = max(4.685 * spread, 5e-3 * radius)
        if np.linalg.norm(at.step) < 1e-7 * radius and target >= 0.95 * half_width:
            return None
        return float(np.clip(target, 0.6 * half_width, half_width))

    surface, first = OrientedPoints(points, samples.normals, area), Band(band, _MIN_COSINE, MIN_SAMPLES)
    fitted = fit_centre(surface, start, radius, first, narrowed, reach=0.5 * radius, most=_STEPS)
    if fitted is None:
        return None
    centre, band, at = fitted.centre, fitted.half_width, fitted.last
    unit, residual, cosine, weights = at.unit, at.residual, at.cosine, at.weights
    inlier = weights > 0
    u, r, w = unit[inlier], residual[inlier], weights[inlier]
    beyond = (np.abs(residual) >= band) & (np.abs(residual) < band + _FLANK * radius) & (cosine > _FLANK_COSINE)
    gain = _tukey_gain(residual, band, area)
    patches = _patches(u, gain * r, w)
    outward = np.sum(samples.outward[inlier] * u, axis=1)
    stated = np.linalg.norm(samples.outward[inlier], axis=1)
    orientation = float(np.sum(w * outward) / max(np.sum(w * stated), 1e-300)) if np.any(stated > 0) else 0.0
    return SphereFit(
        centre=centre,
        rms=float(np.sqrt(np.sum(w * r * r) / np.sum(w))),
        radius_residual=gain * _free_radius(u, r, w),
        coverage=coverage(u),
        orientation=orientation,
        flank=float(np.sum(area[beyond]) / np.sum(area[inlier])),
        form=_form(patches),
        n=int(np.count_nonzero(inlier)),
        patches=patches,
    )


def _tukey_gain(residual: Array, band: float, area: Array) -> float:
    """Attenuation of weighted mean residuals: a shift of the surface moves the mean by the sum of the influence
    function's slopes, not by that of the weights."""
    inside = (np.abs(residual) < band) & (area > 0)
    x2 = (residual[inside] / band) ** 2
    weights = float(np.sum(area[inside] * (1 - x2) ** 2))
    slopes = float(np.sum(area[inside] * (1 - x2) * (1 - 5 * x2)))
    return float(np.clip(weights / max(slopes, 1e-300), 1.0, 1.8))


def _free_radius(u: Array, r: Array, w: Array) -> float:
    # Close to the solution, one linearised step in centre and radius is accurate enough.
    J = np.concatenate([u, np.ones((len(u), 1))], axis=1)
    H = (J * w[:, None]).T @ J
    if np.linalg.eigvalsh(H)[0] < 1e-7 * np.trace(H):
        return float("nan")
    return float(np.linalg.solve(H, (J * w[:, None]).T @ r)[3])


def _form(patches: Patches) -> float:
    J = np.concatenate([patches.unit, np.ones((len(patches.unit), 1))], axis=1)
    root = np.sqrt(patches.weight)
    x = np.linalg.lstsq(J * root[:, None], patches.residual * root, rcond=1e-6)[0]
    return float(np.sqrt(np.sum(patches.weight * (patches.residual - J @ x) ** 2) / np.sum(patches.weight)))


def _patches(u: Array, r: Array, w: Array) -> Patches:
    cell = _PATCH
    while True:
        index = np.floor((u + 1.0) / cell).astype(np.int64)
        _, group = np.unique((index[:, 0] * 64 + index[:, 1]) * 64 + index[:, 2], return_inverse=True)
        n = int(group.max()) + 1
        if n <= _MOST_PATCHES:
            break
        cell *= 1.15
    sums = summed(group, [w, w * r, w * w, *(w * u.T)], n)
    total = sums[:, 0]
    kept = total > 0.02 * float(np.median(total))
    direction = sums[kept, 3:]
    return Patches(
        unit=direction / np.linalg.norm(direction, axis=1, keepdims=True),
        residual=(sums[:, 1] / total)[kept],
        weight=total[kept],
        white=(sums[:, 2] / total**2)[kept],
    )


def coverage(u: Array) -> float:
    """Fraction of the whole sphere covered by directions (N, 3): counted in cells of a cube's faces, so that neither
    uneven density nor a duplicate shell matters."""
    n = int(np.clip(np.sqrt(len(u) / 24), 2, 20))
    axis = np.abs(u).argmax(axis=1)
    rows = np.arange(len(u))
    major = u[rows, axis]
    other = np.stack([u[rows, (axis + 1) % 3], u[rows, (axis + 2) % 3]], axis=1) / np.abs(major)[:, None]
    # Equal angles, not equal lengths, along the cube's faces: cells of nearly equal solid angle.
    i, j = np.minimum(((np.arctan(other) / (np.pi / 2) + 0.5) * n).astype(np.int64), n - 1).T
    cells = np.unique(((axis * 2 + (major > 0)) * n + i) * n + j)
    middle = np.tan((np.arange(n) + 0.5 - n / 2) * (np.pi / 2 / n)) ** 2
    a, b = middle[:, None], middle[None]
    solid = (1 + a) * (1 + b) / (1 + a + b) ** 1.5
    return float(np.sum(solid.ravel()[cells % (n * n)]) / (6 * np.sum(solid)))


def sample_weights(points: Array, cell: float) -> Array:
    """Weights (N,) of points without faces: a cell of surface counts once, however many points are in it."""
    index = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    key = (index[:, 0] * (1 << 20) + index[:, 1]) * (1 << 20) + index[:, 2]
    _, group, count = np.unique(key, return_inverse=True, return_counts=True)
    # A cell that the surface only grazes has few points: use at least half of the median density.
    return 1.0 / np.maximum(count[group], 0.5 * float(np.median(count)))
