"""Searches a layout of spheres for wrong assignments: quadruples that others resemble, and their extensions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.compute.layout.misfits import misfits, rigid_motions
from service.core.geometry import Array

IntArray = NDArray[np.int64]

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
    """All wrong assignments of four up to a misfit of `beyond_m`; if there are none, up to the first found."""
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
    """Quadruples (M, 4) and others (M, 4) with equal pairwise distances, without the quadruple itself."""
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
    """(N, N) between all centres (N, 3)."""
    return np.linalg.norm(centres[:, None] - centres[None], axis=2)


def distinct(matches: Confusions, order: IntArray, most: int = 8) -> list[int]:
    """Indices of the best assignments, each pair of sets once: an assignment and its inverse have equal misfits."""
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
    """The best assignments by number of visible spheres, best first; those of four are extended to more spheres."""
    n = len(centres)
    seen, taken = matches.seen[order[:2000]], matches.taken[order[:2000]]
    found = {SUBSET: Confusions(seen, taken, matches.misfit[order[:2000]])}
    R, t = rigid_motions(centres, seen, taken)
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
