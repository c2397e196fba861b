"""Judges whether a layout distinguishes its spheres, by the wrong assignments that fit nearly as well."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammainc, gammaincc

from service.core.errors import ComputeError, DataError
from service.core.geometry import Array
from service.core.units import deg, mm

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


# For ten random centres, the best wrong assignment of four misfits by 0.5 to 4 mm. Measured centres err by 0.01 mm,
# and an image of exactly those four may be resolved by the others. If five can be confused, nothing resolves them.
REQUIRED_MARGIN_M = 0.4e-3
REQUIRED_MARGIN_OF_FIVE_M = 2.0e-3
REQUIRED_DEPTH_M = 5.0e-3  # rms height over the best plane: a flat layout has no handedness and gives weak poses
LARGEST_GAP_RAD = np.deg2rad(150.0)  # between neighbouring azimuths; above it the spheres are all on one side
_REACH_M = 3.0e-3  # misfits up to which assignments of four are judged and extended to more spheres
_QUANTILE = 2.326  # of the normal distribution at 99 %


@dataclass(frozen=True, slots=True)
class Confusion:
    """A wrong assignment that nearly fits.

    Attributes:
        spheres: indices of the visible spheres.
        taken_for: the spheres that they would be mistaken for, in the same order.
        misfit_m: rms distance after the best rigid motion.
    """

    spheres: tuple[int, ...]
    taken_for: tuple[int, ...]
    misfit_m: float


@dataclass(frozen=True, slots=True)
class BoundedLength:
    """A length in metres with one-sided 99 % bounds; all three values are equal if no uncertainty is known."""

    value_m: float
    lower_m: float
    upper_m: float

    @property
    def sigma_m(self) -> float:
        """Standard deviation of a normal distribution with bounds this far apart."""
        return (self.upper_m - self.lower_m) / (2 * _QUANTILE)


@dataclass(frozen=True, slots=True)
class LayoutReport:
    """The margins by which the spheres of a layout can be distinguished.

    Attributes:
        margin: least misfit of any wrong assignment of any four spheres; noise must stay well below it.
        margin_of_five: least misfit of any wrong assignment of any five spheres; infinite if none was found.
        worst: the assignments with the least misfit, least first.
        margin_by_count_m: least misfit by number of visible spheres (4, 5, … all).
        sphere_margins_m: (N,) least misfit of the assignments that mistake this sphere for another.
        depth: rms distance of the centres from their best plane.
        extent_m: rms distance of the centres from their mean.
        largest_gap_rad: largest gap between neighbouring azimuths around the mean, in the best plane.
        problems: texts that say what must be changed; empty if the layout passes.
    """

    margin: BoundedLength
    margin_of_five: BoundedLength
    worst: tuple[Confusion, ...]
    margin_by_count_m: dict[int, float]
    sphere_margins_m: Array
    depth: BoundedLength
    extent_m: float
    largest_gap_rad: float
    problems: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """True if nothing must be changed."""
        return not self.problems

    @property
    def margin_m(self) -> float:
        """The margin without its bounds."""
        return self.margin.value_m


def check_layout(
    centres_m: Array,
    covariance: Array | None = None,
    *,
    radius_m: float = 0.015,
    required_margin_m: float = REQUIRED_MARGIN_M,
) -> LayoutReport:
    """Judge a layout of spheres before anything is measured with it.

    Every assignment of four spheres to four others (or to themselves in another order) could be a confusion; its
    misfit is the rms distance after the best rigid motion. Mirror-symmetric layouts fail too: two mirrored pairs form
    a trapezoid, which half a turn maps onto itself. The search is exhaustive and uses pairwise distances: if two of
    them differ by more than 2√2 times a misfit, that misfit is impossible.

    Args:
        centres_m: (N, 3), N ≥ 4.
        covariance: (3N, 3N) m² of all centres jointly, or (N, 3, 3) of centres measured one by one.
        radius_m: radius of the spheres.
        required_margin_m: misfit below which a wrong assignment of four counts as possible; use a larger value if the
            centres are only roughly known.

    Raises:
        DataError: the centres are not (N, 3), or not finite.
        ComputeError: fewer than four spheres, or two at the same place.
    """
    centres = _require_centres(centres_m, radius_m)
    joint = _joint(covariance, len(centres))
    matches = confusions(centres, beyond_m=max(2 * required_margin_m, _REACH_M))
    order = np.argsort(matches.misfit, kind="stable")
    worst = tuple(
        Confusion(_ints(matches.seen[k]), _ints(matches.taken[k]), float(matches.misfit[k]))
        for k in distinct(matches, order)
    )
    by_count = by_visible_count(centres, matches, order)
    best = order[:MOST_JUDGED]
    margin = _least(centres, joint, Confusions(matches.seen[best], matches.taken[best], matches.misfit[best]))
    of_five = _least(centres, joint, by_count[SUBSET + 1]) if SUBSET + 1 in by_count else _NO_BOUND
    _, singular, axes = np.linalg.svd(centres - centres.mean(axis=0), full_matrices=False)
    report = LayoutReport(
        margin=margin,
        margin_of_five=of_five,
        worst=worst,
        margin_by_count_m={n: float(m.misfit[0]) for n, m in by_count.items()},
        sphere_margins_m=_sphere_margins(len(centres), matches),
        depth=_depth(centres, singular, axes, joint),
        extent_m=float(np.sqrt(np.mean(np.sum((centres - centres.mean(axis=0)) ** 2, axis=1)))),
        largest_gap_rad=_largest_gap(centres, axes),
        problems=(),
    )
    return replace(report, problems=_problems(report, required_margin_m))


def _require_centres(centres_m: Array, radius_m: float) -> Array:
    """Return the centres as numbers (N, 3). Raises DataError or ComputeError, as `check_layout` says."""
    centres = np.asarray(centres_m, dtype=np.float64)
    if centres.ndim != 2 or centres.shape[1] != 3 or not np.isfinite(centres).all():
        raise DataError(f"sphere centres of shape {centres.shape} are not points (N, 3)")
    if len(centres) < SUBSET:
        raise ComputeError(
            f"{len(centres)} spheres have no layout to judge, {SUBSET} are needed", remedy="Place more spheres"
        )
    if distances(centres)[~np.eye(len(centres), dtype=bool)].min() < radius_m:
        raise ComputeError("two spheres are at the same place", remedy="Check the list of centres for repeats")
    return centres


def _sphere_margins(count: int, matches: Confusions) -> Array:
    """Return (N,) the smallest misfit of an assignment that confuses each sphere; infinite if there is none."""
    margins = np.full(count, np.inf)
    moved = matches.seen != matches.taken
    for column in range(SUBSET):
        chosen = moved[:, column]
        np.minimum.at(margins, matches.seen[chosen, column], matches.misfit[chosen])
    return margins


def _problems(report: LayoutReport, required_margin_m: float) -> tuple[str, ...]:
    """Describe what must be changed, judged by the values themselves; gates judge the bounds."""
    problems: list[str] = []
    if report.margin_m < required_margin_m:
        first = report.worst[0]
        problems.append(
            f"spheres {_names(first.spheres)} can be taken for {_names(first.taken_for)}: "
            f"{mm(report.margin_m):.2f} mm apart, {mm(required_margin_m):.1f} mm are needed"
        )
    if report.margin_of_five.value_m < REQUIRED_MARGIN_OF_FIVE_M:
        problems.append(
            f"five spheres can be taken for others that are {mm(report.margin_of_five.value_m):.2f} mm different, "
            f"{mm(REQUIRED_MARGIN_OF_FIVE_M):.0f} mm are needed"
        )
    if report.depth.value_m < REQUIRED_DEPTH_M:
        problems.append(
            f"the spheres lie within {mm(report.depth.value_m):.1f} mm of a plane, "
            f"{mm(REQUIRED_DEPTH_M):.0f} mm are needed: set some of them higher"
        )
    if report.largest_gap_rad > LARGEST_GAP_RAD:
        problems.append(f"no sphere over {np.rad2deg(report.largest_gap_rad):.0f}° of the way around: spread them")
    return tuple(problems)


def layout_bounds(report: LayoutReport) -> dict[str, tuple[BoundedLength, float]]:
    """Return the numbers of a layout that gates judge, by measure name, each with its required value (m)."""
    found = {
        "layout_margin_mm": (report.margin, REQUIRED_MARGIN_M),
        "layout_margin_of_five_mm": (report.margin_of_five, REQUIRED_MARGIN_OF_FIVE_M),
        "layout_depth_mm": (report.depth, REQUIRED_DEPTH_M),
    }
    return {name: value for name, value in found.items() if np.isfinite(value[0].value_m)}


def layout_measures(report: LayoutReport) -> dict[str, float]:
    """Return the numbers of a layout by measure name, lengths in mm; the same in every step."""
    return {
        **{name: mm(bounded.value_m) for name, (bounded, _) in layout_bounds(report).items()},
        "layout_margin_sigma_mm": mm(report.margin.sigma_m),
        "layout_gap_deg": deg(report.largest_gap_rad),
        "layout_problems": float(len(report.problems)),
    }


_NO_BOUND = BoundedLength(np.inf, np.inf, np.inf)


def _least(centres: Array, joint: Array | None, matches: Confusions) -> BoundedLength:
    """Return the least misfit, bounded by the least of all lower bounds and the least of all upper ones."""
    if joint is None:
        least = float(matches.misfit.min())
        return BoundedLength(least, least, least)
    found = bounded_misfits(centres, joint, matches.seen, matches.taken)
    lower, upper = float(found.lower_m.min()), float(found.upper_m.min())
    return BoundedLength(float(np.clip(found.misfit_m.min(), lower, upper)), lower, upper)


def _depth(centres: Array, singular: Array, axes: Array, joint: Array | None) -> BoundedLength:
    """Return the RMS height over the best plane, with the first-order variance of a singular value."""
    n = len(centres)
    depth = float(singular[2] / np.sqrt(n))
    if joint is None:
        return BoundedLength(depth, depth, depth)
    height = (centres - centres.mean(axis=0)) @ axes[2]
    slope = np.outer(height / max(float(singular[2]), 1e-9) / np.sqrt(n), axes[2]).ravel()
    sigma = float(np.sqrt(slope @ joint @ slope))
    return BoundedLength(depth, max(depth - _QUANTILE * sigma, 0.0), depth + _QUANTILE * sigma)


def _joint(covariance: Array | None, n: int) -> Array | None:
    """Return (3N, 3N) covariance of all centres; None if nothing is known."""
    if covariance is None or covariance.ndim == 2:
        return covariance
    joint = np.zeros((n, 3, n, 3))
    joint[np.arange(n), :, np.arange(n)] = covariance
    return joint.reshape(3 * n, 3 * n)


def _largest_gap(centres: Array, axes: Array) -> float:
    flat = (centres - centres.mean(axis=0)) @ axes[:2].T
    turn = np.sort(np.arctan2(flat[:, 1], flat[:, 0]))
    return float(np.max(np.diff(np.append(turn, turn[0] + 2 * np.pi))))


def _ints(row: IntArray) -> tuple[int, ...]:
    return tuple(int(i) for i in row)


def _names(spheres: Sequence[int]) -> str:
    return ", ".join(str(i) for i in spheres)
