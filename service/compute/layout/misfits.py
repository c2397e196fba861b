"""Misfits of wrong sphere assignments, with bounds from the centres' covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammainc, gammaincc

from service.core.geometry import Array

IntArray = NDArray[np.int64]

CONFIDENCE = 0.99  # of each bound, one-sided
_BISECTIONS = 40


@dataclass(frozen=True, slots=True)
class BoundedMisfits:
    """Misfits (M,) in metres without the part due to noise, and their one-sided bounds."""

    misfit_m: Array
    lower_m: Array
    upper_m: Array


def misfits(centres: Array, seen: IntArray, taken: IntArray) -> Array:
    """Rms distance (M,) after the best proper rigid motion of each assignment (M, n). Source: as `align_points`."""
    if len(seen) == 0:
        return np.empty(0)
    a, b, _, S = _aligned(centres, seen, taken)
    square = np.sum(a**2, axis=(1, 2)) + np.sum(b**2, axis=(1, 2)) - 2 * S.sum(axis=1)
    return np.sqrt(np.maximum(square, 0.0) / seen.shape[1])


def rigid_motions(centres: Array, seen: IntArray, taken: IntArray) -> tuple[Array, Array]:
    """R (M, 3, 3) and t (M, 3) of the rigid motion that best maps `seen` onto `taken`."""
    _, _, R, _ = _aligned(centres, seen, taken)  # a ≈ R b
    turned = np.swapaxes(R, 1, 2)
    return turned, centres[taken].mean(axis=1) - np.einsum("mij,mj->mi", turned, centres[seen].mean(axis=1))


def _aligned(centres: Array, seen: IntArray, taken: IntArray) -> tuple[Array, Array, Array, Array]:
    """Centred points a, b (M, n, 3), R (M, 3, 3) with a ≈ R b, and the singular values, the last one signed."""
    a, b = centres[seen], centres[taken]
    a = a - a.mean(axis=1, keepdims=True)
    b = b - b.mean(axis=1, keepdims=True)
    U, S, Vt = np.linalg.svd(np.einsum("mki,mkj->mij", a, b))
    flip = np.ones_like(S)
    flip[:, 2] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    return a, b, np.einsum("mij,mj,mjk->mik", U, flip, Vt), S * flip


def bounded_misfits(centres: Array, covariance: Array, seen: IntArray, taken: IntArray) -> BoundedMisfits:
    """Misfits of assignments (M, n) and one-sided bounds with probability CONFIDENCE each.

    The residuals r after the best motion have the covariance Q of the noise, less what a rigid motion absorbs. Then
    |r|² has the mean |r₀|² + tr Q and the variance 2 tr Q² + 4 r₀ᵀ Q r₀, with r₀ the true residuals; a gamma
    distribution with these two moments gives the bounds. Source: Satterthwaite (1946), for a non-central sum.

    Args:
        centres: (N, 3).
        covariance: (3N, 3N) m².
        seen, taken: indices of the spheres and of those they are mistaken for.
    """
    n = seen.shape[1]
    a, b, R, _ = _aligned(centres, seen, taken)
    r = a - np.einsum("mij,mkj->mki", R, b)
    Q = _residual_covariance(covariance, a, R, seen, taken)
    flat = r.reshape(len(seen), 3 * n)
    square = np.sum(flat**2, axis=1)
    trace = np.einsum("mii->m", Q)
    trace2 = np.einsum("mij,mji->m", Q, Q)
    along = np.einsum("mi,mij,mj->m", flat, Q, flat) / np.maximum(square, 1e-30)
    plain = np.sqrt(np.maximum(square, 0.0) / n)

    def tail(true_square: Array, *, upper: bool) -> Array:
        mean = true_square + trace
        variance = np.maximum(2 * trace2 + 4 * true_square * along, 1e-40)
        shape, scale = mean**2 / variance, variance / np.maximum(mean, 1e-30)
        return np.asarray((gammainc if upper else gammaincc)(shape, square / scale))

    def solve(low: Array, high: Array, *, upper: bool) -> Array:
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            # The larger the true misfit, the more likely is one above the observed.
            larger = tail(middle, upper=upper) > 1 - CONFIDENCE
            low, high = (
                (np.where(larger, middle, low), np.where(larger, high, middle))
                if upper
                else (np.where(larger, low, middle), np.where(larger, middle, high))
            )
        return 0.5 * (low + high)

    noisy = trace > 1e-18
    reach = square + 10 * trace + 10 * np.sqrt(np.maximum(trace2, 0.0)) + 10 * np.sqrt(square * np.maximum(along, 0))
    lower = np.where(noisy, np.sqrt(solve(np.zeros_like(square), square, upper=False) / n), plain)
    upper = np.where(noisy, np.sqrt(solve(np.zeros_like(square), reach, upper=True) / n), plain)
    value = np.where(noisy, np.sqrt(np.maximum(square - trace, 0.0) / n), plain)
    return BoundedMisfits(np.clip(value, lower, upper), lower, upper)


def _residual_covariance(covariance: Array, a: Array, R: Array, seen: IntArray, taken: IntArray) -> Array:
    """(M, 3n, 3n) covariance of the residuals: the noise of both sides, less what a rigid motion absorbs."""
    M, n = seen.shape
    blocks = covariance.reshape(len(covariance) // 3, 3, -1, 3).transpose(0, 2, 1, 3)  # (N, N, 3, 3)
    ss = blocks[seen[:, :, None], seen[:, None, :]]
    tt = blocks[taken[:, :, None], taken[:, None, :]]
    st = blocks[seen[:, :, None], taken[:, None, :]]
    st = np.einsum("mijab,mcb->mijac", st, R)
    both = ss + np.einsum("mda,mijab,mcb->mijdc", R, tt, R) - st - st.transpose(0, 2, 1, 4, 3)
    S = both.transpose(0, 1, 3, 2, 4).reshape(M, 3 * n, 3 * n)
    motions = np.zeros((M, n, 3, 6))
    motions[:, :, :, :3] = np.eye(3)
    for axis in range(3):
        motions[:, :, :, 3 + axis] = np.cross(np.eye(3)[axis], a)
    basis, _ = np.linalg.qr(motions.reshape(M, 3 * n, 6))
    P = np.eye(3 * n) - basis @ basis.transpose(0, 2, 1)
    return P @ S @ P
