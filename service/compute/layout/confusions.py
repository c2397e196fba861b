"""Finds wrong assignments of a layout's spheres that fit nearly as well as the right one, with bounds of misfits."""

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
    """Return rms distance (M,) after the best rigid motion of each assignment (M, n). Source: as `align_points`."""
    if len(seen) == 0:
        return np.empty(0)
    a, b, _, S = _aligned(centres, seen, taken)
    square = np.sum(a**2, axis=(1, 2)) + np.sum(b**2, axis=(1, 2)) - 2 * S.sum(axis=1)
    return np.sqrt(np.maximum(square, 0.0) / seen.shape[1])


def _rigid_motions(centres: Array, seen: IntArray, taken: IntArray) -> tuple[Array, Array]:
    """Return R (M, 3, 3) and t (M, 3) of the rigid motion that best maps `seen` onto `taken`."""
    _, _, R, _ = _aligned(centres, seen, taken)  # a ≈ R b
    turned = np.swapaxes(R, 1, 2)
    return turned, centres[taken].mean(axis=1) - np.einsum("mij,mj->mi", turned, centres[seen].mean(axis=1))


def _aligned(centres: Array, seen: IntArray, taken: IntArray) -> tuple[Array, Array, Array, Array]:
    """Return centred a, b (M, n, 3), R (M, 3, 3) with a ≈ R b, and the singular values, the last one signed."""
    a, b = centres[seen], centres[taken]
    a = a - a.mean(axis=1, keepdims=True)
    b = b - b.mean(axis=1, keepdims=True)
    U, S, Vt = np.linalg.svd(np.einsum("mki,mkj->mij", a, b))
    flip = np.ones_like(S)
    flip[:, 2] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    return a, b, np.einsum("mij,mj,mjk->mik", U, flip, Vt), S * flip


def bounded_misfits(centres: Array, covariance: Array, seen: IntArray, taken: IntArray) -> BoundedMisfits:
    """Return the misfits of assignments (M, n) and one-sided bounds with probability CONFIDENCE each.

    The residuals r after the best motion have the covariance Q of the noise, less what a rigid motion absorbs. Then
    |r|² has the mean |r₀|² + tr Q and the variance 2 tr Q² + 4 r₀ᵀ Q r₀, with r₀ the true residuals; a gamma
    distribution with these two moments gives the bounds. Source: Satterthwaite (1946), for a non-central sum.

    Args:
        centres: (N, 3) the spheres' centres.
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
    """Return (M, 3n, 3n) covariance of the residuals: the noise of both sides, less what a rigid motion absorbs."""
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


SUBSET = 4  # least number of spheres visible in an image
_FIRST_TOLERANCE_M = 1.0e-3
_ROWS = 2_000_000  # combinations processed at a time
_MOST_MATCHES = 200_000  # a layout with so many near-symmetries needs no longer list
MOST_JUDGED = 600  # assignments whose bounds are computed, the best first


@dataclass(frozen=True, slots=True)
class Confusions:
    """Wrong assignments: `seen` (M, n) are taken for `taken` (M, n), with these misfits (M,) in metres."""

    seen: IntArray
    taken: IntArray
    misfit: Array


def confusions(centres: Array, beyond_m: float = 0.0) -> Confusions:
    """Return all wrong assignments of four up to a misfit of `beyond_m`; if there are none, up to the first found."""
    between = distances(centres)
    tolerance = max(_FIRST_TOLERANCE_M, beyond_m)
    while True:
        seen, taken = similar(between, 2 * np.sqrt(2.0) * tolerance)
        misfit = misfits(centres, seen, taken)
        sure = misfit <= tolerance
        if np.any(sure):
            return Confusions(seen[sure], taken[sure], misfit[sure])
        tolerance *= 2


def similar(between: Array, tolerance: float) -> tuple[IntArray, IntArray]:
    """Return the quadruples (M, 4) and others (M, 4) with equal pairwise distances, without the quadruple itself."""
    n = len(between)
    seen = np.stack(np.triu_indices(n, 1), axis=1)
    taken = np.array([(p, q) for p in range(n) for q in range(n) if p != q])
    a, b = np.nonzero(
        np.abs(between[seen[:, 0], seen[:, 1]][:, None] - between[taken[:, 0], taken[:, 1]][None]) < tolerance
    )
    seen, taken = seen[a], taken[b]
    for _ in range(SUBSET - 2):
        step = max(1, _ROWS // (n * n))
        parts = [
            _extended(between, seen[k : k + step], taken[k : k + step], tolerance) for k in range(0, len(seen), step)
        ]
        seen = np.concatenate([s for s, _ in parts]) if parts else np.empty((0, seen.shape[1] + 1), dtype=np.int64)
        taken = np.concatenate([t for _, t in parts]) if parts else seen
        if len(seen) > _MOST_MATCHES:
            seen, taken = seen[:_MOST_MATCHES], taken[:_MOST_MATCHES]
    wrong = np.any(seen != taken, axis=1)
    return seen[wrong], taken[wrong]


def _extended(between: Array, seen: IntArray, taken: IntArray, tolerance: float) -> tuple[IntArray, IntArray]:
    n = len(between)
    agree = np.ones((len(seen), n, n), dtype=np.bool_)
    for column in range(seen.shape[1]):
        agree &= np.abs(between[seen[:, column]][:, :, None] - between[taken[:, column]][:, None, :]) < tolerance
    later = np.arange(n)[None] > seen[:, -1:]
    agree &= later[:, :, None]
    for column in range(taken.shape[1]):
        agree[np.arange(len(taken)), :, taken[:, column]] = False
    row, new, image = np.nonzero(agree)
    return (
        np.concatenate([seen[row], new[:, None]], axis=1),
        np.concatenate([taken[row], image[:, None]], axis=1),
    )


def distances(centres: Array) -> Array:
    """Return (N, N) distances between all centres (N, 3)."""
    return np.linalg.norm(centres[:, None] - centres[None], axis=2)


def distinct(matches: Confusions, order: IntArray, most: int = 8) -> list[int]:
    """Select the best assignments, each pair of sets once: an assignment and its inverse have equal misfits."""
    chosen: list[int] = []
    known: set[frozenset[tuple[int, int]]] = set()
    for k in order[: 50 * most]:
        pairs = frozenset((int(i), int(j)) for i, j in zip(matches.seen[k], matches.taken[k], strict=True))
        if pairs in known or frozenset((j, i) for i, j in pairs) in known:
            continue
        known.add(pairs)
        chosen.append(int(k))
        if len(chosen) == most:
            break
    return chosen


def by_visible_count(centres: Array, matches: Confusions, order: IntArray) -> dict[int, Confusions]:
    """Select the best assignments by number of visible spheres; those of four are extended to more spheres."""
    n = len(centres)
    seen, taken = matches.seen[order[:2000]], matches.taken[order[:2000]]
    found = {SUBSET: Confusions(seen, taken, matches.misfit[order[:2000]])}
    R, t = _rigid_motions(centres, seen, taken)
    carried = np.einsum("mij,nj->mni", R, centres) + t[:, None]
    distance = np.linalg.norm(carried[:, :, None] - centres[None, None], axis=3)
    rows = np.arange(len(seen))
    for column in range(SUBSET):
        distance[rows, seen[:, column]] = np.inf
        distance[rows, :, taken[:, column]] = np.inf
    for count in range(SUBSET + 1, n + 1):
        i, j = np.divmod(distance.reshape(len(seen), -1).argmin(axis=1), n)
        distance[rows, i] = np.inf
        distance[rows, :, j] = np.inf
        seen, taken = np.concatenate([seen, i[:, None]], axis=1), np.concatenate([taken, j[:, None]], axis=1)
        misfit = misfits(centres, seen, taken)
        best = np.argsort(misfit, kind="stable")[:MOST_JUDGED]
        found[count] = Confusions(seen[best], taken[best], misfit[best])
    return found
