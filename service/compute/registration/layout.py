"""Whether placed spheres can be told from one another: the least misfit of any wrong assignment, and what to move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.core.errors import ComputeError, DataError
from service.core.geometry import Array, align_points, apply

IntArray = NDArray[np.int64]

SUBSET = 4  # spheres that an image shows at least
# Ten centres at random leave 0.5 to 4 mm to the best wrong assignment of four; measured centres err by 0.01 mm, and
# one image of exactly those four may be told by the others. Five that can be mistaken leave nothing to tell them by.
REQUIRED_MARGIN_M = 0.4e-3
REQUIRED_MARGIN_OF_FIVE_M = 2.0e-3
REQUIRED_DEPTH_M = 5.0e-3  # rms height over the best plane: a flat layout has no handedness and weak poses
LARGEST_GAP_RAD = np.deg2rad(150.0)  # between neighbouring azimuths: wider, and the spheres stand on one side only
_FIRST_TOLERANCE_M = 1.0e-3
_ROWS = 2_000_000  # combinations worked on at a time
_MOST_MATCHES = 200_000  # a layout with so many near-symmetries needs no longer list
_MOVE_M = 0.04  # how far a sphere is tried elsewhere
_MOST_MOVES = 5


@dataclass(frozen=True, slots=True)
class Confusion:
    """A wrong assignment that nearly fits.

    Attributes:
        spheres: indices that are seen.
        taken_for: the spheres that they would be taken for, in the same order.
        misfit_m: rms distance after the best rigid motion.
    """

    spheres: tuple[int, ...]
    taken_for: tuple[int, ...]
    misfit_m: float


@dataclass(frozen=True, slots=True)
class Move:
    """A sphere that is better placed elsewhere.

    Attributes:
        sphere: its index.
        by_m: (3,) shift in the frame of the centres.
        margin_m: of the layout after this move and those before it.
    """

    sphere: int
    by_m: Array
    margin_m: float


@dataclass(frozen=True, slots=True)
class LayoutReport:
    """How well the spheres of a layout can be told apart.

    Attributes:
        margin_m: least misfit of any wrong assignment of any four spheres: what noise must stay well below.
        margin_sigma_m: its standard deviation by the centres' uncertainties; 0 when they are not given.
        worst: the assignments that fit best, best first.
        margin_by_count_m: least misfit found when so many spheres are seen (4, 5, … all).
        sphere_margins_m: (N,) least misfit among the assignments that take this sphere for another.
        depth_m: rms distance of the centres from their best plane.
        extent_m: rms distance of the centres from their mean.
        largest_gap_rad: between neighbouring azimuths around the mean, in the best plane.
        problems: what must be changed, in words; none: the layout passes.
        moves: one after the other, which spheres to move and roughly where to; only sought where the margin is too
            small.
    """

    margin_m: float
    margin_sigma_m: float
    worst: tuple[Confusion, ...]
    margin_by_count_m: dict[int, float]
    sphere_margins_m: Array
    depth_m: float
    extent_m: float
    largest_gap_rad: float
    problems: tuple[str, ...]
    moves: tuple[Move, ...]

    @property
    def passed(self) -> bool:
        """Whether nothing must be changed."""
        return not self.problems


def check_layout(
    centres_m: Array,
    covariances: Array | None = None,
    *,
    radius_m: float = 0.015,
    required_margin_m: float = REQUIRED_MARGIN_M,
) -> LayoutReport:
    """Judge a layout of spheres, before anything is measured with it.

    Every assignment of four spheres to four others (or to themselves in another order) is a way to mistake them;
    its misfit is that of the best rigid motion. Mirror-symmetric layouts fail too: two mirrored pairs make a
    trapezoid, which half a turn maps onto itself. The search is exhaustive, by pairwise distances: distances that
    differ by more than 2√2 times a misfit rule that misfit out.

    Args:
        centres_m: (N, 3), N ≥ 4.
        covariances: (N, 3, 3) of the centres, m².
        radius_m: of the spheres; moves keep them apart.
        required_margin_m: misfit below which a wrong assignment of four counts as possible; give more when the
            centres are only roughly known.

    Raises:
        DataError: not centres (N, 3), or not finite.
        ComputeError: fewer than four spheres, or two at the same place.
    """
    centres = np.asarray(centres_m, dtype=np.float64)
    if centres.ndim != 2 or centres.shape[1] != 3 or not np.isfinite(centres).all():
        raise DataError(f"sphere centres of shape {centres.shape} are not points (N, 3)")
    if len(centres) < SUBSET:
        raise ComputeError(
            f"{len(centres)} spheres have no layout to judge, {SUBSET} are needed", remedy="place more spheres"
        )
    between = _distances(centres)
    if between[~np.eye(len(centres), dtype=bool)].min() < radius_m:
        raise ComputeError("two spheres are at the same place", remedy="check the list of centres for repeats")
    matches = _confusions(centres, beyond_m=max(2 * required_margin_m, REQUIRED_MARGIN_OF_FIVE_M))
    order = np.argsort(matches.misfit, kind="stable")
    margin = float(matches.misfit[order[0]])
    worst = tuple(
        Confusion(_ints(matches.seen[k]), _ints(matches.taken[k]), float(matches.misfit[k]))
        for k in _distinct(matches, order)
    )
    sphere_margins = np.full(len(centres), np.inf)
    moved = matches.seen != matches.taken
    for column in range(SUBSET):
        chosen = moved[:, column]
        np.minimum.at(sphere_margins, matches.seen[chosen, column], matches.misfit[chosen])
    _, singular, axes = np.linalg.svd(centres - centres.mean(axis=0), full_matrices=False)
    depth = float(singular[2] / np.sqrt(len(centres)))
    gap = _largest_gap(centres, axes)
    problems: list[str] = []
    if margin < required_margin_m:
        first = worst[0]
        problems.append(
            f"spheres {_names(first.spheres)} can be taken for {_names(first.taken_for)}: "
            f"{margin * 1e3:.2f} mm apart, {required_margin_m * 1e3:.1f} mm are needed"
        )
    by_count = _by_count(centres, matches, order)
    of_five = by_count.get(SUBSET + 1, np.inf)
    if of_five < REQUIRED_MARGIN_OF_FIVE_M:
        problems.append(
            f"five spheres can be taken for others that are {of_five * 1e3:.2f} mm different, "
            f"{REQUIRED_MARGIN_OF_FIVE_M * 1e3:.0f} mm are needed"
        )
    if depth < REQUIRED_DEPTH_M:
        problems.append(
            f"the spheres lie within {depth * 1e3:.1f} mm of a plane, {REQUIRED_DEPTH_M * 1e3:.0f} mm are needed: "
            "set some of them higher"
        )
    if gap > LARGEST_GAP_RAD:
        problems.append(f"no sphere over {np.rad2deg(gap):.0f}° of the way around: spread them")
    return LayoutReport(
        margin_m=margin,
        margin_sigma_m=0.0 if covariances is None else _sigma(worst[0], covariances),
        worst=worst,
        margin_by_count_m=by_count,
        sphere_margins_m=sphere_margins,
        depth_m=depth,
        extent_m=float(np.sqrt(np.mean(np.sum((centres - centres.mean(axis=0)) ** 2, axis=1)))),
        largest_gap_rad=gap,
        problems=tuple(problems),
        moves=_moves(centres, radius_m, required_margin_m) if margin < required_margin_m else (),
    )


def layout_record(report: LayoutReport) -> dict[str, Any]:
    """The report as plain data, lengths in mm."""
    return {
        "passed": report.passed,
        "problems": list(report.problems),
        "margin_mm": 1e3 * report.margin_m,
        "margin_sigma_mm": 1e3 * report.margin_sigma_m,
        "margin_by_count_mm": {str(k): 1e3 * v for k, v in report.margin_by_count_m.items() if np.isfinite(v)},
        "worst": [
            {"spheres": list(c.spheres), "taken_for": list(c.taken_for), "misfit_mm": 1e3 * c.misfit_m}
            for c in report.worst
        ],
        "depth_mm": 1e3 * report.depth_m,
        "extent_mm": 1e3 * report.extent_m,
        "largest_gap_deg": float(np.rad2deg(report.largest_gap_rad)),
        "moves": [
            {"sphere": m.sphere, "by_mm": (1e3 * m.by_m).tolist(), "margin_mm": 1e3 * m.margin_m}
            for m in report.moves
        ],
    }


# --- search ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Matches:
    seen: IntArray  # (M, 4) ascending indices
    taken: IntArray  # (M, 4)
    misfit: Array  # (M,) metres


def _confusions(centres: Array, beyond_m: float = 0.0) -> _Matches:
    """All wrong assignments of four up to a misfit of `beyond_m`, or more until there is one."""
    between = _distances(centres)
    tolerance = max(_FIRST_TOLERANCE_M, beyond_m)
    while True:
        seen, taken = _similar(between, 2 * np.sqrt(2.0) * tolerance)
        misfit = _misfits(centres, seen, taken)
        sure = misfit <= tolerance
        if np.any(sure):
            return _Matches(seen[sure], taken[sure], misfit[sure])
        tolerance *= 2


def _similar(between: Array, tolerance: float) -> tuple[IntArray, IntArray]:
    """Quadruples (M, 4) and others (M, 4) whose six distances agree; the quadruple itself is left out."""
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


def _misfits(centres: Array, seen: IntArray, taken: IntArray) -> Array:
    """rms (M,) after the best proper rigid motion of each assignment. Source: as `align_points`."""
    if len(seen) == 0:
        return np.empty(0)
    a, b = centres[seen], centres[taken]
    a = a - a.mean(axis=1, keepdims=True)
    b = b - b.mean(axis=1, keepdims=True)
    H = np.einsum("mki,mkj->mij", a, b)
    U, S, Vt = np.linalg.svd(H)
    S[:, 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    square = np.sum(a**2, axis=(1, 2)) + np.sum(b**2, axis=(1, 2)) - 2 * S.sum(axis=1)
    return np.sqrt(np.maximum(square, 0.0) / seen.shape[1])


def _distances(centres: Array) -> Array:
    return np.linalg.norm(centres[:, None] - centres[None], axis=2)


# --- what follows from it -------------------------------------------------------------------------------


def _distinct(matches: _Matches, order: IntArray, most: int = 8) -> list[int]:
    """The best assignments, each pair of sets once: an assignment and its inverse fit alike."""
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


def _by_count(centres: Array, matches: _Matches, order: IntArray) -> dict[int, float]:
    """Least misfit with more spheres seen: the best assignments of four, carried on to the others."""
    n = len(centres)
    best = dict.fromkeys(range(SUBSET, n + 1), np.inf)
    best[SUBSET] = float(matches.misfit[order[0]])
    for k in order[:2000]:
        T, _ = align_points(centres[matches.taken[k]], centres[matches.seen[k]])
        carried = apply(T, centres)
        seen, taken = [int(i) for i in matches.seen[k]], [int(i) for i in matches.taken[k]]
        distance = np.linalg.norm(carried[:, None] - centres[None], axis=2)
        while len(seen) < n:
            rows = [i for i in range(n) if i not in seen]
            columns = [j for j in range(n) if j not in taken]
            part = distance[np.ix_(rows, columns)]
            i, j = np.unravel_index(int(part.argmin()), part.shape)
            seen.append(rows[int(i)])
            taken.append(columns[int(j)])
            misfit = _misfits(centres, np.array([seen]), np.array([taken]))[0]
            best[len(seen)] = min(best[len(seen)], float(misfit))
    return best


def _largest_gap(centres: Array, axes: Array) -> float:
    flat = (centres - centres.mean(axis=0)) @ axes[:2].T
    turn = np.sort(np.arctan2(flat[:, 1], flat[:, 0]))
    return float(np.max(np.diff(np.append(turn, turn[0] + 2 * np.pi))))


def _sigma(confusion: Confusion, covariances: Array) -> float:
    """First order: each coordinate of a misfit has the variances of both centres; rotations absorb some of it."""
    variance = [np.trace(covariances[i]) + np.trace(covariances[j]) for i, j in _pairs(confusion)]
    return float(np.sqrt(np.mean(variance) / 3.0 / len(variance)))


def _pairs(confusion: Confusion) -> list[tuple[int, int]]:
    return list(zip(confusion.spheres, confusion.taken_for, strict=True))


def _moves(centres: Array, radius: float, required: float) -> tuple[Move, ...]:
    """Moves, one after the other, each of which leaves the fewest confusions below the requirement."""
    placed = centres.copy()
    _, _, axes = np.linalg.svd(centres - centres.mean(axis=0), full_matrices=False)
    turns = np.arange(6) * (np.pi / 3) + 0.3
    # Up, down and slantwise: a sphere that only slides in the plane of the others stays in their symmetries.
    directions = [np.cos(t) * axes[0] + np.sin(t) * axes[1] + s * axes[2] for t in turns for s in (0.0, 0.7)]
    directions += [axes[2], -axes[2]]
    chosen: list[Move] = []
    for _ in range(_MOST_MOVES):
        seen, taken = _similar(_distances(placed), 2 * np.sqrt(2.0) * required)
        wrong = _misfits(placed, seen, taken) < required
        if not np.any(wrong):
            break
        involved = np.bincount(seen[wrong][seen[wrong] != taken[wrong]], minlength=len(placed))
        best: tuple[int, int, Array, Array] | None = None
        for sphere in np.argsort(-involved, kind="stable")[:2]:
            for direction in directions:
                trial = placed.copy()
                trial[sphere] += _MOVE_M * direction
                if np.min(np.delete(np.linalg.norm(trial - trial[sphere], axis=1), sphere)) < 2.5 * radius:
                    continue
                left = _misfits(trial, *_similar(_distances(trial), 2 * np.sqrt(2.0) * required)) < required
                if best is None or np.count_nonzero(left) < best[0]:
                    best = (int(np.count_nonzero(left)), int(sphere), _MOVE_M * direction, trial)
        if best is None or best[0] >= np.count_nonzero(wrong):
            break
        placed = best[3]
        chosen.append(Move(best[1], best[2], float(_confusions(placed).misfit.min())))
    return tuple(chosen)


def _ints(row: IntArray) -> tuple[int, ...]:
    return tuple(int(i) for i in row)


def _names(spheres: Sequence[int]) -> str:
    return ", ".join(str(i) for i in spheres)
