"""Fits a sphere of known radius robustly to a mesh or cloud reduced to surfels, with the covariance of its centre."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh, null_space
from scipy.special import chdtri

from service.core.geometry import Array

IntArray = NDArray[np.int64]

CHUNK = 1_000_000  # faces or points processed at a time, which limits the memory
MOST_SAMPLES = 3_000_000  # of a denser mesh, every n-th face is used; a cell still holds dozens of them
_PLANAR = 0.3  # smallest over middle variance of a cell's samples, above which they are not planar
_STEADY = 0.5  # length of the sum of the area vectors over the sum of their lengths, below which they disagree


@dataclass(frozen=True, slots=True)
class Surfels:
    """Cells of a surface, each reduced to one sample.

    Attributes:
        position: (N, 3) centroids.
        normal: (N, 3) unit normals of either sign.
        area: (N,) m².
        outward: (N, 3) area-weighted mean of the unit normals in the data; 0 if there are none.
    """

    position: Array
    normal: Array
    area: Array
    outward: Array


def surfels(vertices: Array, faces: IntArray, normals: Array | None, cell: float) -> Surfels:
    """Reduce a mesh (V, 3), (F, 3), or a point cloud (no faces), to surfels of cubic cells with edge `cell`.

    Normals come from the spread of the samples in a cell, so that neither noise of single faces nor their winding
    matters; in cells with too few samples, from the faces' areas or the points' normals (V, 3).
    """
    low = vertices.min(axis=0)
    size = np.floor((vertices.max(axis=0) - low) / cell).astype(np.int64) + 2
    total = len(faces) or len(vertices)
    stride = -(-total // MOST_SAMPLES)
    keys: list[IntArray] = []
    sums: list[Array] = []
    for begin in range(0, total, CHUNK * stride):
        chosen = slice(begin, min(begin + CHUNK * stride, total), stride)
        if len(faces):
            a, b, c = (vertices[faces[chosen, k]] for k in range(3))
            vector = np.cross(b - a, c - a) * (0.5 * stride)
            point = (a + b + c) / 3 - low
            weight = np.linalg.norm(vector, axis=1)
        else:
            point = vertices[chosen] - low
            weight = np.ones(len(point))
            vector = np.zeros_like(point) if normals is None else normals[chosen]
        index = np.floor(point / cell).astype(np.int64)
        key, group = np.unique((index[:, 0] * size[1] + index[:, 1]) * size[2] + index[:, 2], return_inverse=True)
        x, y, z = point.T
        columns = [np.ones(len(point)), weight, *(weight * p for p in (x, y, z)), *vector.T]
        columns += [weight * p for p in (x * x, y * y, z * z, x * y, x * z, y * z)]
        keys.append(key)
        sums.append(summed(group, columns, len(key)))
    merged, group = np.unique(np.concatenate(keys), return_inverse=True)
    stacked = np.concatenate(sums)
    cells = summed(group, list(stacked.T), len(merged))
    return _from_sums(cells[cells[:, 1] > 0], low, cell, is_mesh=len(faces) > 0)


def _from_sums(cells: Array, low: Array, cell: float, *, is_mesh: bool) -> Surfels:
    count, weight = cells[:, 0], cells[:, 1]
    mean = cells[:, 2:5] / weight[:, None]
    vector = cells[:, 5:8] / weight[:, None]
    second = cells[:, 8:14] / weight[:, None]
    spread = np.empty((len(cells), 3, 3))
    for n, (i, j) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
        spread[:, i, j] = spread[:, j, i] = second[:, n] - mean[:, i] * mean[:, j]
    values, axes = np.linalg.eigh(spread)
    length = np.linalg.norm(vector, axis=1)
    planar = values[:, 0] < _PLANAR * values[:, 1]
    by_spread = planar & (count >= 12)
    by_vector = ~by_spread & (length > _STEADY)
    by_few = ~by_spread & ~by_vector & planar & (count >= 5)
    normal = np.where(by_vector[:, None], vector / np.maximum(length, 1e-300)[:, None], axes[:, :, 0])
    # The average area of a plane in a cell; crumpled and duplicate faces have more.
    usual = cell**2 / np.abs(normal).sum(axis=1)
    area = np.minimum(weight, 2 * usual) if is_mesh else usual
    kept = by_spread | by_vector | by_few
    return Surfels(mean[kept] + low, normal[kept], area[kept], vector[kept])


def summed(group: IntArray, columns: list[Array], n: int) -> Array:
    """Return the sums (n, len(columns)) of the columns (N,) over the rows of each group (N,)."""
    return np.stack([np.bincount(group, column, n).astype(np.float64) for column in columns], axis=1)


def grid_keys(points: Array, low: Array, size: IntArray, cell: float) -> IntArray:
    """Return keys (N,) of the cells of points (N, 3), in a grid of `size` cells (3,) from one cell before `low`."""
    index = np.floor((points - low) / cell).astype(np.int64) + 1
    return (index[:, 0] * size[1] + index[:, 1]) * size[2] + index[:, 2]


# Of the directions: least eigenvalue over the trace; below it, a cap is too flat to fix the centre.
LEAST_SPREAD = 1e-3


@dataclass(frozen=True, slots=True)
class Band:
    """The rule by which samples have a weight in a fit.

    Attributes:
        half_width: residual beyond which a sample has no weight, m.
        min_cosine: least cosine between normal and radius; below it, a sample is not on the sphere.
        min_samples: least number of samples; below it, there is no fit.
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
        cosine: (N,) cosine between normal and radius, without sign.
        eligible: (N,) true if a sample lies in the band.
        weights: (N,) Tukey's weights times the samples' areas.
        step: (3,) step of the centre, m.
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
        area: (N,) area that each sample represents.
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
    """Return Tukey's weights (N,) of residuals (N,) that lie in a band of this half-width (N,)."""
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
    """Fit the centre of a sphere; None if its surface is not there, or the centre moves beyond `reach`.

    It is a reweighted fit, not least squares of a fixed cost: the band shrinks with the residuals until both settle.

    Args:
        surface: samples near the sphere.
        start: (3,) initial centre, m.
        radius: radius of the sphere, m.
        band: rule that selects the samples at first.
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
    """Take a weighted Gauss–Newton step of the centre; None if too few samples lie in the band, or too flat a cap."""
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
        points: (N, 3) the places, m.
        normals: (N, 3) unit, of either sign, averaged over the neighbourhood.
        outward: (N, 3) normals in the data (0 if none), averaged over the neighbourhood.
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
    """A finished fit of a sphere to a surface.

    Attributes:
        centre: (3,), m.
        rms: weighted root mean square distance of the inliers, m.
        radius_residual: radius of a free fit minus the known one, m; NaN if the inliers do not determine it.
        coverage: solid angle of the inliers, as a fraction of the whole sphere.
        orientation: 1 if the normals in the data point away from the centre, -1 if towards it, 0 if they disagree or
            there are none.
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
    """Fit a sphere of known radius (Tukey) from a centre that is good to `band`; None if too few inliers remain."""
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
    """Return the attenuation of weighted mean residuals: a shift of the surface moves the mean by the sum of the
    influence function's slopes, not by that of the weights."""
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
    """Return the fraction of the whole sphere covered by directions (N, 3): counted in cells of a cube's faces, so
    that neither uneven density nor a duplicate shell matters."""
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
    """Weigh (N,) points without faces: a cell of surface counts once, however many points are in it."""
    index = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    key = (index[:, 0] * (1 << 20) + index[:, 1]) * (1 << 20) + index[:, 2]
    _, group, count = np.unique(key, return_inverse=True, return_counts=True)
    # A cell that the surface only grazes has few points: use at least half of the median density.
    return 1.0 / np.maximum(count[group], 0.5 * float(np.median(count)))


LENGTHS = (0.08, 0.16, 0.28, 0.45, 0.75)  # correlation lengths that are tried, in radii
RATIOS = (0.0, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)  # correlated over white variance of a patch
_SHARED_DOF = 12.0  # weight, in degrees of freedom, of the variance common to all spheres against a sphere's own
_FLOOR = 5e-5  # sigma of a perfect mesh, in radii: rounding of single-precision coordinates


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Noise of a surface: V = s² (diag(white) + ratio · mean(white) · G), with G a Matérn 5/2 correlation.

    Attributes:
        length: correlation length, in radii.
        ratio: correlated over white variance of a patch's mean.
        scale: (K,) s² of each sphere, m².
    """

    length: float
    ratio: float
    scale: Array


@dataclass(frozen=True, slots=True)
class CentreUncertainty:
    """Uncertainty of a sphere fit.

    Attributes:
        covariance: (3, 3) covariance of the centre, m².
        radius_sigma: standard deviation of the free radius, m.
    """

    covariance: Array
    radius_sigma: float


def estimate_noise(spheres: Sequence[Patches]) -> NoiseModel:
    """Estimate noise by restricted maximum likelihood over a grid of lengths and ratios, from all spheres' residuals.

    Centre and radius of each sphere are projected out first, so that the part absorbed by the fit is accounted for.

    Source: Patterson & Thompson, "Recovery of inter-block information when block sizes are unequal",
    Biometrika 58(3), 1971.
    """
    best: tuple[float, float, float, Array] | None = None
    usable = [p for p in spheres if len(p.residual) >= 8]
    floor = 1e-18
    if not usable:
        scale = np.array([_own_variance(p) for p in spheres])
        return NoiseModel(LENGTHS[2], 10.0, np.maximum(scale, floor))
    contrasts = [null_space(np.concatenate([p.unit, np.ones((len(p.unit), 1))], axis=1).T) for p in usable]
    for length in LENGTHS:
        parts = [_spectrum(p, K, length) for p, K in zip(usable, contrasts, strict=True)]
        for ratio in RATIOS:
            cost = 0.0
            tried: list[float] = []
            for values, y in parts:
                variance = 1 + ratio * values
                scale = max(float(np.mean(y * y / variance)), floor)
                tried.append(scale)
                cost += float(np.sum(np.log(variance))) + len(y) * float(np.log(scale))
            if best is None or cost < best[0] - 1e-9:
                best = (cost, length, ratio, np.array(tried))
    assert best is not None
    _, length, ratio, scales = best
    dof = np.array([len(p.residual) - 4.0 for p in usable])
    shared = float(np.sum(scales * dof) / np.sum(dof))
    shrunk = (scales * dof + shared * _SHARED_DOF) / (dof + _SHARED_DOF)
    by_identity = {id(p): float(s) for p, s in zip(usable, shrunk, strict=True)}
    return NoiseModel(length, ratio, np.array([by_identity.get(id(p), shared) for p in spheres]))


def _own_variance(p: Patches) -> float:
    return (
        float(np.sum(p.weight * p.residual**2) / np.sum(p.weight * p.white))
        * len(p.weight)
        / max(len(p.weight) - 4, 1)
    )


def _correlation(unit: Array, length: float) -> Array:
    d = np.linalg.norm(unit[:, None] - unit[None], axis=2) * (np.sqrt(5.0) / length)
    return (1 + d + d * d / 3) * np.exp(-d)


def _spectrum(p: Patches, K: Array, length: float) -> tuple[Array, Array]:
    """Return eigenvalues of the correlated relative to the white part among the contrasts, and residuals there."""
    white = K.T @ (K * p.white[:, None])
    shared = K.T @ (_correlation(p.unit, length) * float(np.mean(p.white))) @ K
    values, vectors = eigh(shared, white, check_finite=False)
    return np.maximum(values, 0.0), vectors.T @ (K.T @ p.residual)


def centre_uncertainties(
    spheres: Sequence[Patches], radius_residuals: Sequence[float], radius: float
) -> tuple[CentreUncertainty, ...]:
    """Compute covariances of the weighted known-radius fits; if the free radii deviate by more than noise explains,
    the effect on the centres is added."""
    noise = estimate_noise(spheres)
    parts: list[tuple[Array, Array, float]] = []
    for p, scale in zip(spheres, noise.scale, strict=True):
        V = scale * (np.diag(p.white) + noise.ratio * float(np.mean(p.white)) * _correlation(p.unit, noise.length))
        weighted = p.unit * p.weight[:, None]
        B = np.linalg.solve(weighted.T @ p.unit, weighted.T)
        J = np.concatenate([p.unit, np.ones((len(p.unit), 1))], axis=1)
        free = np.linalg.pinv((J * p.weight[:, None]).T @ J, rcond=1e-9) @ (J * p.weight[:, None]).T
        sigma = float(np.sqrt(max(free[3] @ V @ free[3], 0.0)))
        parts.append((B @ V @ B.T, B.sum(axis=1), max(sigma, _FLOOR * radius)))
    sigmas = np.array([sigma for _, _, sigma in parts])
    residuals = np.array(radius_residuals)
    known = np.isfinite(residuals)
    extra = 0.0
    if np.any(known):
        z2 = (residuals[known] / sigmas[known]) ** 2
        if float(np.sum(z2)) > float(chdtri(len(z2), 0.01)):
            w = 1 / sigmas[known] ** 4
            extra = max(float(np.sum(w * (residuals[known] ** 2 - sigmas[known] ** 2)) / np.sum(w)), 0.0)
    floor = (_FLOOR * radius) ** 2 * np.eye(3)
    return tuple(CentreUncertainty(C + floor + extra * np.outer(g, g), s) for C, g, s in parts)
