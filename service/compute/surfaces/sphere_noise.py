"""Estimates the covariance of fitted sphere centres whose noise is correlated between neighbours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh, null_space
from scipy.special import chdtri

from service.compute.surfaces.sphere_fit import Patches
from service.core.geometry import Array

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
