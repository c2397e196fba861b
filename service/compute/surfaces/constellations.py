"""Compares sphere centres of two measurements: registers them, merges partial scans, and finds moved spheres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from service.compute.descent import gauss_newton
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, align_points, apply, place_jacobian, transform
from service.core.units import MISTAKEN_LENGTHS, mistaken_length, mm

_MIRROR = np.array([-1.0, 1.0, 1.0])
# A match finds scales that are off by 0.7 %, in a scene of 300 mm; the spheres' known radius excludes others.
_NEAR_A_UNIT = 0.01  # relative
_FACTORS = (*(1.01**k for k in range(-12, 13) if k), *MISTAKEN_LENGTHS.values())
_LEAST = 4  # spheres that agree: three lie in a plane, and agree with a mirror image too


@dataclass(frozen=True, slots=True)
class ConstellationMatch:
    """Registration of two constellations.

    Attributes:
        T_a_b: maps frame b to frame a.
        pairs: (index in a, index in b), sorted.
        residuals_m: (P,) distance of each pair after registration.
        missing_a: indices in a without a partner in b.
        missing_b: indices in b without a partner in a.
    """

    T_a_b: Transform
    pairs: tuple[tuple[int, int], ...]
    residuals_m: Array
    missing_a: tuple[int, ...]
    missing_b: tuple[int, ...]

    @property
    def rms_m(self) -> float:
        """Root mean square of the residuals, metres."""
        return float(np.sqrt(np.mean(self.residuals_m**2)))


def match_constellations(a: Array, b: Array, tolerance_m: float = 2e-3) -> ConstellationMatch:
    """Return the rigid T_a_b between sphere centres a (M, 3) and b (N, 3) in metres, in any order.

    Triangles with equal sides propose poses; the pose that brings most spheres within `tolerance_m` wins. Spheres
    missing from either set are reported. Handedness is checked, so that a mirrored copy (an axis negated by a DICOM
    tool) is detected.

    Raises:
        ComputeError: fewer than four spheres agree, all of them lie in a plane (so that a mirror image cannot be
            recognised), the sets are mirror images, or two different assignments fit equally well.
    """
    proper = _best(a, b, tolerance_m)
    mirrored = _best(a, b * _MIRROR, tolerance_m)
    count_mirrored = _count(mirrored)
    if count_mirrored > _count(proper):
        raise ComputeError(
            f"the two sphere constellations are mirror images ({count_mirrored} spheres agree only when mirrored)",
            remedy="One mesh has an axis negated: export it again, or correct the orientation of the CT series",
        )
    if not proper:
        raise ComputeError(
            f"no {_LEAST} of {len(a)} and {len(b)} spheres agree within {mm(tolerance_m):.1f} mm"
            + _words_of_other_scale(a, b, tolerance_m),
            remedy="Check that both are of the same specimen, the units of both meshes, and that the spheres did not "
            "move between the scans",
        )
    best, rival = proper[0], proper[1:]
    rows = np.array([i for i, _ in best])
    spread = np.linalg.svd(a[rows] - a[rows].mean(axis=0), compute_uv=False)
    if spread[2] < 2 * tolerance_m:
        raise ComputeError(
            "the matched spheres lie in a plane, so that a mirrored mesh could not be distinguished from a true one",
            remedy="Mount at least one sphere at another height",
        )
    if any(len(other) == len(best) for other in rival):
        raise ComputeError(
            f"the sphere constellation is symmetric: {len(best)} spheres agree in more than one way",
            remedy="Move one sphere so that no rotation maps the arrangement onto itself",
        )
    columns = np.array([j for _, j in best])
    T_a_b, _ = align_points(a[rows], b[columns])
    residuals = np.linalg.norm(a[rows] - apply(T_a_b, b[columns]), axis=1)
    return ConstellationMatch(
        T_a_b,
        best,
        residuals,
        tuple(sorted(set(range(len(a))) - set(rows.tolist()))),
        tuple(sorted(set(range(len(b))) - set(columns.tolist()))),
    )


Pairs = tuple[tuple[int, int], ...]


def _words_of_other_scale(a: Array, b: Array, tolerance_m: float) -> str:
    """Describe the scale of the second in which at least five spheres agree; an empty text if there is none."""
    best: Pairs = ()
    for factor in _FACTORS:
        found = _best(a, factor * b, tolerance_m)
        best = max(best, *found[:1], key=len) if found else best
    if len(best) <= _LEAST:
        return ""
    rows, columns = (np.array(side) for side in zip(*best, strict=True))
    _, scale = align_points(a[rows], b[columns], with_scale=True)
    unit = mistaken_length(scale, _NEAR_A_UNIT)
    return (
        f"; with the second multiplied by {scale:.4f}{f' ({unit})' if unit else ''}, {len(best)} do: one of them has "
        "a wrong scale or unit"
    )


def _count(solutions: list[Pairs]) -> int:
    return len(solutions[0]) if solutions else 0


def _best(a: Array, b: Array, tolerance: float) -> list[Pairs]:
    """Return the largest consistent assignment of at least four, and all different ones of the same size."""
    found: dict[Pairs, float] = {}
    size = _LEAST
    for ta, tb in _triangles(a, b, tolerance):
        T, _ = align_points(a[ta], b[tb])
        pairs, _ = _assign(a, apply(T, b), 2 * tolerance)
        if len(pairs) < size:
            continue
        # The proposing triangle's noise is amplified over the whole scene: refit before judging.
        rows, columns = (np.array(side) for side in zip(*pairs, strict=True))
        refitted, _ = align_points(a[rows], b[columns])
        pairs, error = _assign(a, apply(refitted, b), tolerance)
        if len(pairs) >= size:
            if len(pairs) > size:
                found.clear()
            size = len(pairs)
            found[pairs] = error
            if size == min(len(a), len(b)) and len(found) > 1:
                break
    return sorted(found, key=found.__getitem__)


def _assign(a: Array, b_in_a: Array, tolerance: float) -> tuple[Pairs, float]:
    distance = np.linalg.norm(a[:, None] - b_in_a[None], axis=2)
    rows, columns = linear_sum_assignment(np.minimum(distance, 2 * tolerance))
    near = distance[rows, columns] < tolerance
    pairs = tuple((int(i), int(j)) for i, j in zip(rows[near], columns[near], strict=True))
    return pairs, float(np.sum(distance[rows[near], columns[near]] ** 2))


def _triangles(a: Array, b: Array, tolerance: float) -> list[tuple[list[int], list[int]]]:
    """Return index triples of a and b with three equal sides; triples of a are taken in one order only."""
    da = np.linalg.norm(a[:, None] - a[None], axis=2)
    db = np.linalg.norm(b[:, None] - b[None], axis=2)
    out: list[tuple[list[int], list[int]]] = []
    for i in range(len(a)):
        for j in range(i + 1, len(a)):
            k, m = np.nonzero(np.abs(db - da[i, j]) < tolerance)
            distinct = k != m
            for p, q in zip(k[distinct], m[distinct], strict=True):
                # (third of a) × (third of b): both remaining sides must agree.
                agree = (np.abs(da[i][:, None] - db[p][None]) < tolerance) & (
                    np.abs(da[j][:, None] - db[q][None]) < tolerance
                )
                agree[: j + 1] = False  # the triples in this order alone
                agree[:, [p, q]] = False
                out += [([i, j, int(t)], [int(p), int(q), int(s)]) for t, s in zip(*np.nonzero(agree), strict=True)]
    return out


_ROUNDS = 30  # of the common adjustment; it converges in a few


@dataclass(frozen=True, slots=True)
class MergedParts:
    """The poses of parts in the frame of the first one.

    Attributes:
        T_first_part: (4, 4) pose of each part, metres; the identity for the first.
        spheres: number of different spheres.
        shared: number of spheres that two parts or more show.
        residuals_m: distance of every sphere that is shared, in every part, from its mean over the parts.
    """

    T_first_part: tuple[Transform, ...]
    spheres: int
    shared: int
    residuals_m: Array

    @property
    def rms_m(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.mean(self.residuals_m**2)))


def merge_parts(parts_m: Sequence[Array]) -> MergedParts:
    """Place parts by their spheres, and adjust all poses together.

    Args:
        parts_m: sphere centres (N, 3) of each part in its own frame, metres.

    Raises:
        ComputeError: a part shares fewer than four spheres with the others, all of them in a plane, or is mirrored;
            names the part.
    """
    poses: dict[int, Transform] = {0: np.eye(4)}
    members: list[dict[int, int]] = [{0: index} for index in range(len(parts_m[0]))]  # of a sphere: part → its index
    while len(poses) < len(parts_m):
        part, T, pairs = _next(parts_m, poses, members)
        poses[part] = T
        known = {index: sphere for sphere, index in pairs}
        for index in range(len(parts_m[part])):
            if index in known:
                members[known[index]][part] = index
            else:
                members.append({part: index})
    shared = [sphere for sphere in members if len(sphere) > 1]
    for _ in range(_ROUNDS):
        means = [_mean(sphere, parts_m, poses) for sphere in shared]
        for part in range(1, len(parts_m)):
            rows = [(mean, sphere[part]) for mean, sphere in zip(means, shared, strict=True) if part in sphere]
            target, own = np.array([mean for mean, _ in rows]), parts_m[part][[index for _, index in rows]]
            poses[part], _ = align_points(target, own)
    residuals = [
        np.linalg.norm(apply(poses[part], parts_m[part][index]) - _mean(sphere, parts_m, poses))
        for sphere in shared
        for part, index in sphere.items()
    ]
    ordered = tuple(poses[part] for part in range(len(parts_m)))
    return MergedParts(ordered, len(members), len(shared), np.array(residuals, dtype=np.float64))


def _next(
    parts_m: Sequence[Array], poses: dict[int, Transform], members: list[dict[int, int]]
) -> tuple[int, Transform, tuple[tuple[int, int], ...]]:
    """Select the part that shares most spheres with those placed: its pose, and the pairs (sphere, own index)."""
    placed = np.array([_mean(sphere, parts_m, poses) for sphere in members])
    found: list[tuple[int, int, Transform, tuple[tuple[int, int], ...]]] = []
    failed: dict[int, ComputeError] = {}
    for part in range(len(parts_m)):
        if part in poses:
            continue
        try:
            match = match_constellations(placed, parts_m[part])
        except ComputeError as error:
            failed[part] = error
            continue
        found.append((len(match.pairs), -part, match.T_a_b, match.pairs))
    if not found:
        part, error = next(iter(failed.items()))
        raise ComputeError(
            f"part {part + 1} of the scan cannot be placed: {error.what}",
            remedy="Scan every part so that it shows four spheres of another part, not all in a plane",
        ) from error
    _, minus, T, pairs = max(found, key=lambda one: one[:2])
    return -minus, T, pairs


def _mean(sphere: dict[int, int], parts_m: Sequence[Array], poses: dict[int, Transform]) -> Array:
    """Return the mean position (3,) of a sphere over the parts that show it, in the frame of the first."""
    return np.mean([apply(poses[part], parts_m[part][index]) for part, index in sphere.items()], axis=0)


SYSTEMATIC_SIGMA_M = 2.0e-5  # per coordinate: difference of two instruments beyond their noise (scale, temperature)
MOVED_PROBABILITY = 1.0e-3  # of a false alarm: some sphere is reported as moved though none did


@dataclass(frozen=True, slots=True)
class SphereDifference:
    """One sphere in both measurements, in a common frame defined by the spheres that did not move.

    Attributes:
        pair: (index in a, index in b).
        difference_m: (3,) position in b minus position in a, in frame a.
        sigma_m: standard deviation of the difference along its direction, including the registration's.
        z: Mahalanobis length of the difference.
        moved: true if the sphere counts as moved.
    """

    pair: tuple[int, int]
    difference_m: Array
    sigma_m: float
    z: float
    moved: bool


@dataclass(frozen=True, slots=True)
class LoopClosure:
    """Comparison of two measurements of one scene.

    Attributes:
        T_a_b: rigid transform by the spheres that did not move, weighted by the covariances.
        spheres: the spheres' differences, in the order of the match's pairs.
        chi2_per_dof: chi square of the spheres that did not move; near 1 if the given uncertainties are right.
        rms_m: root mean square difference of the spheres that did not move.
        sigma_rms_m: predicted rms from the given uncertainties.
        scale: lengths in b over lengths in a, by all spheres: one of two instruments may be calibrated wrongly.
        scale_sigma: its standard deviation.
    """

    T_a_b: Transform
    spheres: tuple[SphereDifference, ...]
    chi2_per_dof: float
    rms_m: float
    sigma_rms_m: float
    scale: float
    scale_sigma: float

    @property
    def moved(self) -> tuple[SphereDifference, ...]:
        """The spheres that moved, the most significant first."""
        return tuple(sorted((s for s in self.spheres if s.moved), key=lambda s: -s.z))


def close_loop(
    a: Array,
    covariances_a: Array,
    b: Array,
    covariances_b: Array,
    match: ConstellationMatch,
    systematic_sigma_m: float = SYSTEMATIC_SIGMA_M,
) -> LoopClosure:
    """Compare the matched spheres of two measurements and name those that moved.

    Each sphere is predicted from the others. The one farthest from its prediction is set aside if chance does not
    explain it, and the rest are judged again.

    Args:
        a: (M, 3) centres, metres.
        covariances_a: (M, 3, 3), m².
        b: (N, 3) centres in another frame, metres.
        covariances_b: (N, 3, 3), m².
        match: correspondence of the spheres.
        systematic_sigma_m: added to every coordinate of a difference.

    Raises:
        ComputeError: fewer than four common spheres.
    """
    if len(match.pairs) < _LEAST:
        raise ComputeError(f"{len(match.pairs)} spheres in common do not close a loop", remedy="Scan all spheres")
    rows, columns = (np.array(side) for side in zip(*match.pairs, strict=True))
    pa, pb = a[rows], b[columns]
    R = match.T_a_b[:3, :3]
    C = covariances_a[rows] + R @ covariances_b[columns] @ R.T + systematic_sigma_m**2 * np.eye(3)
    staying = np.ones(len(pa), dtype=np.bool_)
    limit = MOVED_PROBABILITY / len(pa)
    while staying.sum() > _LEAST:
        z2 = np.array([_against_others(pa, pb, C, staying, int(i), match.T_a_b)[1] for i in np.flatnonzero(staying)])
        worst = int(z2.argmax())
        if chdtrc(3, float(z2[worst])) >= limit:
            break
        staying[np.flatnonzero(staying)[worst]] = False
    T, _ = _weighted(pa[staying], pb[staying], C[staying], match.T_a_b)
    spheres: list[SphereDifference] = []
    for i, pair in enumerate(match.pairs):
        difference, z2, sigma = _against_others(pa, pb, C, staying, i, T)
        spheres.append(SphereDifference(pair, difference, sigma, float(np.sqrt(z2)), moved=not bool(staying[i])))
    d = apply(T, pb[staying]) - pa[staying]
    dof = 3 * int(staying.sum()) - 6
    statistic = float(np.einsum("ni,nij,nj->", d, np.linalg.inv(C[staying]), d))
    expected = float(np.trace(C[staying], axis1=1, axis2=2).sum()) * dof / (3 * staying.sum())
    return LoopClosure(
        T_a_b=T,
        spheres=tuple(spheres),
        chi2_per_dof=statistic / dof,
        rms_m=float(np.sqrt(np.mean(np.sum(d**2, axis=1)))),
        sigma_rms_m=float(np.sqrt(expected / staying.sum())),
        scale=align_points(pb, pa, with_scale=True)[1],
        scale_sigma=float(np.sqrt(np.trace(C, axis1=1, axis2=2).mean() / 3 / np.sum((pa - pa.mean(axis=0)) ** 2))),
    )


def _against_others(
    a: Array, b: Array, C: Array, staying: NDArray[np.bool_], i: int, start: Transform
) -> tuple[Array, float, float]:
    """Return the difference (3,) of sphere i from the others' prediction, squared Mahalanobis length, and sigma."""
    others = staying.copy()
    others[i] = False
    T, covariance = _weighted(a[others], b[others], C[others], start)
    predicted = apply(T, b[i])
    J = place_jacobian(predicted[None])[0]
    S = C[i] + J @ covariance @ J.T
    d = predicted - a[i]
    length = float(np.linalg.norm(d))
    along = d / length if length > 0 else np.array([1.0, 0.0, 0.0])
    return d, float(d @ np.linalg.solve(S, d)), float(np.sqrt(along @ S @ along))


def _weighted(a: Array, b: Array, C: Array, start: Transform) -> tuple[Transform, Array]:
    """Fit rigid T_a_b by generalised least squares, with covariance (6, 6) of (t, w) at a's origin, outer frame."""
    W = np.linalg.inv(C)

    def equations(T: Transform) -> tuple[Array, Array]:
        points = apply(T, b)
        J = place_jacobian(points)
        JW = np.einsum("nki,nkl->nil", J, W)
        return np.einsum("nil,nlj->ij", JW, J), np.einsum("nil,nl->i", JW, a - points)

    T = gauss_newton(
        start,
        lambda T: np.asarray(np.linalg.solve(*equations(T)), dtype=np.float64),
        lambda T, step: transform(Rotation.from_rotvec(step[3:]), step[:3]) @ T,
        most=8,
        settled=1e-12,
    )
    return T, np.asarray(np.linalg.inv(equations(T)[0]), dtype=np.float64)
