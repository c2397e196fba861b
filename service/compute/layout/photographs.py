"""Sphere centres from one or more photographs taken with an uncalibrated camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from service.compute.layout.confusions import distances
from service.compute.layout.photo_adjustment import AdjustedLayout, LensPrior, SpherePhotograph, adjust
from service.compute.markers.cones import Cone
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, align_points, apply, inverse

IntArray = NDArray[np.int64]

LEAST_SPHERES = 4
_TOLERANCE_M = 0.015  # between centres from two single photographs: depths err by some millimetres
_TRIANGLES = 10  # largest triangles of the leading photograph, with which poses of another are proposed
_PROPOSALS = 4000
_READINGS = 3  # assignments of one photograph that are tried in the joint adjustment
_APART = 1.5  # radii, least distance of two centres: 2 for spheres that touch, less their uncertainty
_ASIDE, _BEHIND = (
    0.5,
    4.0,
)  # radii: of an outline's ray from a sphere that is not seen, and of its depth by size from it
_WORST_CHI2 = 20.0  # per degree of freedom: above it, the photograph shows something else


@dataclass(frozen=True, slots=True)
class PhotoLayout:
    """The spheres of all photographs in one frame.

    Attributes:
        centres_m: (N, 3) centres in the frame of the leading photograph.
        covariance: (3N, 3N) m² of all centres jointly.
        spheres: the sphere of each of a photograph's outlines (-1: none), for every photograph; an empty array if the
            photograph could not be used.
        T_photo_first: the map from the centres' frame to each photograph's own; None if it could not be used.
        chi2: chi square of the adjustment, per degree of freedom.
    """

    centres_m: Array
    covariance: Array
    spheres: tuple[IntArray, ...]
    T_photo_first: tuple[Transform | None, ...]
    chi2: float

    @property
    def used(self) -> int:
        """Number of photographs used."""
        return sum(T is not None for T in self.T_photo_first)


def layout_from_photographs(
    photographs: Sequence[SpherePhotograph], radius_m: float, prior: LensPrior, expected: int | None = None
) -> PhotoLayout:
    """Compute one layout from photographs of spheres that did not move in between.

    The photograph with the most spheres leads. From a single photograph, depths follow from the outlines' sizes, to
    some tenths of a millimetre at best. With a second viewpoint they follow from the directions, ten times better,
    and the camera is calibrated at the same time.

    Args:
        photographs: photographs taken by one camera.
        radius_m: radius of the spheres.
        prior: prior of the camera's parameters.
        expected: number of spheres; if more are found, those seen in the fewest photographs are dropped.

    Raises:
        ComputeError: no photograph shows four spheres.
    """
    order = sorted(range(len(photographs)), key=lambda k: -len(photographs[k].cones))
    if not order or len(photographs[order[0]].cones) < LEAST_SPHERES:
        most = max((len(p.cones) for p in photographs), default=0)
        raise ComputeError(
            f"no photograph shows more than {most} spheres, {LEAST_SPHERES} are needed",
            remedy="Photograph all spheres from above, sharp and from less than a metre",
        )
    first = photographs[order[0]]
    group = _Group([order[0]], [np.arange(len(first.cones))], [np.eye(4)])
    found = _adjusted(photographs, group, places_by_size(first.cones, radius_m), radius_m, prior)
    for k in order[1:]:
        group, found = _add_photograph(photographs, group, found, k, radius_m, prior)
    if expected is not None and len(found.centres_m) > expected:
        group, found = _reduced(photographs, group, found, expected, radius_m, prior)
    spheres: list[IntArray] = [np.empty(0, dtype=np.int64)] * len(photographs)
    poses: list[Transform | None] = [None] * len(photographs)
    for k, ids, T in zip(group.photographs, group.spheres, found.T_photo_first, strict=True):
        spheres[k], poses[k] = ids, T
    return PhotoLayout(found.centres_m, found.covariance, tuple(spheres), tuple(poses), found.chi2)


@dataclass(frozen=True, slots=True)
class _Group:
    """The photographs registered so far: their numbers, the spheres of their outlines (-1: none), their poses."""

    photographs: list[int]
    spheres: list[IntArray]
    poses: list[Transform]


def _adjusted(
    photographs: Sequence[SpherePhotograph], group: _Group, centres: Array, radius_m: float, prior: LensPrior
) -> AdjustedLayout:
    chosen: list[SpherePhotograph] = []
    spheres: list[IntArray] = []
    for k, ids in zip(group.photographs, group.spheres, strict=True):
        shown = np.nonzero(ids >= 0)[0]
        photo = photographs[k]
        chosen.append(SpherePhotograph(photo.camera, tuple(photo.cones[i] for i in shown), photo.covariances[shown]))
        spheres.append(ids[shown])
    return adjust(chosen, spheres, centres, group.poses, radius_m, prior)


def _add_photograph(
    photographs: Sequence[SpherePhotograph],
    group: _Group,
    found: AdjustedLayout,
    k: int,
    radius_m: float,
    prior: LensPrior,
) -> tuple[_Group, AdjustedLayout]:
    """Return the group with photograph k added by its best-fitting assignment; unchanged if none fits."""
    places = places_by_size(photographs[k].cones, radius_m)
    best: tuple[_Group, AdjustedLayout] | None = None
    best_rank = (True, np.inf)
    for T_first_photo, pairs in _readings(found.centres_m, places):
        ids = np.full(len(places), -1, dtype=np.int64)
        for sphere, outline in pairs:
            ids[outline] = sphere
        new = np.nonzero(ids < 0)[0]
        ids[new] = len(found.centres_m) + np.arange(len(new))
        centres = np.concatenate([found.centres_m, apply(T_first_photo, places[new])])
        joined = _Group(
            [*group.photographs, k], [*group.spheres, ids], [*found.T_photo_first, inverse(T_first_photo)]
        )
        try:
            adjusted = _adjusted(photographs, joined, centres, radius_m, prior)
            single = _without_doubles(joined, adjusted, len(found.centres_m), radius_m)
            if len(single[1]) < len(adjusted.centres_m):
                joined, adjusted = single[0], _adjusted(photographs, *single, radius_m, prior)
        except ComputeError:
            continue  # this assignment does not fit
        # Spheres are solid: an assignment by which two still overlap counts only if there is no other.
        rank = (_nearest_m(adjusted.centres_m) < _APART * radius_m, adjusted.chi2)
        if adjusted.chi2 < _WORST_CHI2 and (best is None or rank < best_rank):
            best, best_rank = (joined, adjusted), rank
    return (group, found) if best is None else best


def _without_doubles(joined: _Group, adjusted: AdjustedLayout, known: int, radius_m: float) -> tuple[_Group, Array]:
    """Drop the newest photograph's spheres that are known ones from the group and its centres.

    Spheres are solid: one that lies in a known one is that sphere, or outlined twice, and then none. In the direction
    of a known sphere that the photograph shows nowhere else, the outline is that sphere's, though by its size it is
    nearer or farther.

    Args:
        joined: the group, with the newest photograph last.
        adjusted: the group's layout.
        known: number of spheres before that photograph; its own come behind.
        radius_m: radius of the spheres.
    """
    ids = joined.spheres[-1].copy()
    kept = np.ones(len(adjusted.centres_m), dtype=bool)
    seen = apply(adjusted.T_photo_first[-1], adjusted.centres_m)
    ray = seen[known:] / np.linalg.norm(seen[known:], axis=1, keepdims=True)
    along = np.abs(ray @ seen[:known].T - np.linalg.norm(seen[known:], axis=1, keepdims=True))
    gap = distances(adjusted.centres_m)[known:, :known]
    aside = np.sqrt(np.maximum(gap**2 - along**2, 0.0))
    inside, behind = gap < _APART * radius_m, (aside < _ASIDE * radius_m) & (along < _BEHIND * radius_m)
    for row in np.argsort(gap.min(axis=1), kind="stable"):
        unseen = ~np.isin(np.arange(known), ids)
        same = np.flatnonzero(inside[row] | (behind[row] & unseen))
        if len(same):
            sphere = int(same[np.argmin(aside[row, same])])
            ids[ids == known + row] = sphere if unseen[sphere] else -1
            kept[known + row] = False
    number = np.append(np.cumsum(kept) - 1, -1)  # the last for outlines of no sphere
    spheres = [number[one] for one in (*joined.spheres[:-1], ids)]
    return _Group(joined.photographs, spheres, list(adjusted.T_photo_first)), adjusted.centres_m[kept]


def _nearest_m(centres: Array) -> float:
    """Return the least distance between two of the centres (N, 3)."""
    return float(distances(centres)[~np.eye(len(centres), dtype=bool)].min())


def _reduced(
    photographs: Sequence[SpherePhotograph],
    group: _Group,
    found: AdjustedLayout,
    expected: int,
    radius_m: float,
    prior: LensPrior,
) -> tuple[_Group, AdjustedLayout]:
    """Drop the spheres seen in the fewest photographs, which are other round objects."""
    count = np.bincount(np.concatenate([i[i >= 0] for i in group.spheres]), minlength=len(found.centres_m))
    kept = np.sort(np.argsort(-count, kind="stable")[:expected])
    if count[kept].min() == count[np.setdiff1d(np.arange(len(count)), kept)].max():
        return group, found  # a tie: nothing shows which are wrong, and the wrong count is reported
    number = np.full(len(count) + 1, -1, dtype=np.int64)
    number[kept] = np.arange(expected)
    smaller = _Group(group.photographs, [number[ids] for ids in group.spheres], list(found.T_photo_first))
    return smaller, _adjusted(photographs, smaller, found.centres_m[kept], radius_m, prior)


def places_by_size(cones: Sequence[Cone], radius_m: float) -> Array:
    """Return (n, 3) centres in the photograph's own frame, with depths from the outlines' sizes."""
    return np.array(
        [cone.axis * (radius_m / np.sin(cone.half_angle_rad)) for cone in cones], dtype=np.float64
    ).reshape(-1, 3)


def _readings(a: Array, b: Array) -> list[tuple[Transform, list[tuple[int, int]]]]:
    """Return T_a_b and pairs (index in a, index in b) for every way in which b (N, 3) matches a (M, 3), best first.

    Nearly symmetric layouts match in more than one way: the adjustment decides between them, and if it cannot, the
    layout is the same either way.
    """
    if min(len(a), len(b)) < LEAST_SPHERES:
        return []
    rows, columns = _alike_triangles(a, b)
    T = _rigid(a[rows], b[columns])
    gap = np.linalg.norm(
        a[None, :, None] - (np.einsum("mij,nj->mni", T[:, :3, :3], b) + T[:, None, :3, 3])[:, None], axis=3
    )
    nearest = gap.min(axis=1)
    score = np.sum(np.minimum(nearest / _TOLERANCE_M, 1.0) ** 2, axis=1)
    found: dict[tuple[tuple[int, int], ...], tuple[float, Transform]] = {}
    for m in np.argsort(score, kind="stable")[:40]:
        pairs, refined, cost = _refined(a, b, T[m])
        if len(pairs) >= LEAST_SPHERES:
            found.setdefault(tuple(pairs), (cost + 2.0 * (len(b) - len(pairs)), refined))
    ranked = sorted(found.items(), key=lambda item: item[1][0])[:_READINGS]
    return [(value[1], list(pairs)) for pairs, value in ranked]


def _refined(a: Array, b: Array, start: Transform) -> tuple[list[tuple[int, int]], Transform, float]:
    """Return pairs within the tolerance, their fitted pose, and their sum of squares relative to the tolerance's."""
    pairs: list[tuple[int, int]] = []
    cost, T_a_b = float("inf"), start
    for _ in range(2):
        gap = np.linalg.norm(a[:, None] - apply(T_a_b, b)[None], axis=2)
        rows, columns = linear_sum_assignment(np.minimum(gap, 2 * _TOLERANCE_M))
        near = gap[rows, columns] < _TOLERANCE_M
        pairs = [(int(i), int(j)) for i, j in zip(rows[near], columns[near], strict=True)]
        if len(pairs) < LEAST_SPHERES:
            break
        cost = float(np.sum((gap[rows[near], columns[near]] / _TOLERANCE_M) ** 2))
        T_a_b, _ = align_points(a[rows[near]], b[columns[near]])
    return pairs, T_a_b, cost


def _alike_triangles(a: Array, b: Array) -> tuple[IntArray, IntArray]:
    """Return index triples (M, 3) into a (its largest triangles only) and into b, with equal sides."""
    da, db = (np.linalg.norm(x[:, None] - x[None], axis=2) for x in (a, b))
    i, j, k = np.array([(p, q, r) for p in range(len(a)) for q in range(p) for r in range(q)]).T
    area = np.linalg.norm(np.cross(a[j] - a[i], a[k] - a[i]), axis=1)
    rows: list[IntArray] = []
    columns: list[IntArray] = []
    for t in np.argsort(-area, kind="stable")[:_TRIANGLES]:
        p, q, r = i[t], j[t], k[t]
        agree = (
            (np.abs(db - da[p, q]) < _TOLERANCE_M)[:, :, None]
            & (np.abs(db - da[p, r]) < _TOLERANCE_M)[:, None, :]
            & (np.abs(db - da[q, r]) < _TOLERANCE_M)[None]
        )
        found = np.argwhere(agree)
        found = found[(found[:, 0] != found[:, 1]) & (found[:, 0] != found[:, 2]) & (found[:, 1] != found[:, 2])]
        columns.append(found)
        rows.append(np.tile(np.array([p, q, r]), (len(found), 1)))
    return np.concatenate(rows)[:_PROPOSALS], np.concatenate(columns)[:_PROPOSALS]


def _rigid(a: Array, b: Array) -> Array:
    """Return T_a_b (M, 4, 4) for point triples a, b (M, 3, 3). Source: as `align_points`."""
    mean_a, mean_b = a.mean(axis=1), b.mean(axis=1)
    H = np.einsum("mki,mkj->mij", b - mean_b[:, None], a - mean_a[:, None])
    U, _, Vt = np.linalg.svd(H)
    flip = np.ones((len(a), 3))
    flip[:, 2] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    T = np.tile(np.eye(4), (len(a), 1, 1))
    T[:, :3, :3] = np.einsum("mji,mj,mkj->mik", Vt, flip, U)
    T[:, :3, 3] = mean_a - np.einsum("mij,mj->mi", T[:, :3, :3], mean_b)
    return T
