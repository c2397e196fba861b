"""Computes the Chamfer distance of the paper between two surfaces, evenly sampled, and the usual scores beside it."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain, islice

import numpy as np

from service.compute.surfaces.surface import (
    IntArray,
    NearestOfBlocks,
    PointIndex,
    Surface,
    TriangleTree,
    show,
    z_order,
)
from service.core.errors import ComputeError
from service.core.geometry import Array
from service.core.units import mm

MOST_SAMPLES = 40_000_000  # of one surface; more are nearly always a mistaken unit
_BLOCK = 1_000_000
_TOGETHER = 4  # blocks in a region
_PLACES = 25_000  # made at a time, which fits into the processor's cache


@dataclass(frozen=True, slots=True)
class Samples:
    """Points on a surface.

    Attributes:
        points_m: (N, 3) the samples' places.
        origin: (N,) index of the face that each point lies on, or of the cloud's point.
        normals: (N, 3) unit normals; None for a cloud without.
    """

    points_m: Array = field(repr=False)
    origin: IntArray = field(repr=False)
    normals: Array | None = field(repr=False)


class BlockedSamples:
    """The samples of a surface, made block by block whenever they are wanted: all of them may take gigabytes.

    A mesh is sampled at random, with one point per spacing²; a cloud is thinned to one point per cube of the spacing.
    Every face gets its share of the points, rounded up or down, at random places. The draws do not depend on the
    frame. A cloud that is sparser than the spacing stays as it is: points cannot be invented.

    Raises:
        ComputeError: the surface has no area, or would need more than MOST_SAMPLES points.
    """

    def __init__(self, surface: Surface, spacing_m: float, rng: np.random.Generator) -> None:
        self._surface = surface
        self._draws: list[np.random.Generator] = []  # as they were before each block
        if not surface.is_mesh:
            self._cloud = _thinned(surface, spacing_m)
            self.n = len(self._cloud.points_m)
            return
        self._upto = _counts(surface, spacing_m, rng)
        self.n = int(self._upto[-1])
        for begin in range(0, self.n, _BLOCK):
            self._draws.append(copy.deepcopy(rng))
            rng.random((2, min(_BLOCK, self.n - begin), 1))  # those of the block, which is made later

    @property
    def sizes(self) -> tuple[int, ...]:
        """How many samples each block has."""
        return tuple(min(_BLOCK, self.n - begin) for begin in range(0, self.n, _BLOCK))

    def blocks(self, some: Sequence[IntArray] | None = None) -> Iterator[Samples]:
        """Yield all samples in order, in blocks of up to a million; the same ones each time.

        `some` chooses from each block by their numbers in it (K,), in order; a block of which none is wanted is left
        out.
        """
        for number, count in enumerate(self.sizes):
            begin, chosen = number * _BLOCK, np.arange(count) if some is None else some[number]
            if not len(chosen):
                continue
            if not self._surface.is_mesh:
                of = self._cloud
                normals = None if of.normals is None else of.normals[begin + chosen]
                yield Samples(of.points_m[begin + chosen], of.origin[begin + chosen], normals)
                continue
            origin = np.searchsorted(self._upto, begin + chosen, side="right")
            drawn = copy.deepcopy(self._draws[number]).random((2, count))
            yield Samples(_places(self._surface, origin, drawn if some is None else drawn[:, chosen]), origin, None)

    def regions(self) -> Iterator[Samples]:
        """Yield all samples, those together that lie together, without normals; a region is larger than a block.

        In a file whose faces have no spatial order, each block is spread over the whole surface.
        """
        runs = -(-self.n // (_TOGETHER * _BLOCK))
        places = self._surface.vertices_m[self._surface.faces[:, 0]] if self._surface.is_mesh and runs > 1 else None
        if places is None or not _overlap(places, runs):
            blocks = self.blocks()
            while some := list(islice(blocks, _TOGETHER)):
                points_m, origin = _take_together(some)
                yield Samples(points_m, origin, None)
            return
        order = z_order(places)
        del places
        count = np.diff(self._upto, prepend=0)
        first = np.empty_like(count)  # samples that come before those of a face in this order
        first[order] = np.cumsum(count[order]) - count[order]
        region = np.empty(self.n, dtype=np.uint16)
        for begin in range(0, self.n, _BLOCK):
            at = np.arange(begin, min(begin + _BLOCK, self.n))
            of = np.searchsorted(self._upto, at, side="right")
            region[at] = (first[of] + at - (self._upto[of] - count[of])) // (_TOGETHER * _BLOCK)
        for number in range(int(region.max()) + 1):
            chosen = [np.flatnonzero(region[begin : begin + _BLOCK] == number) for begin in range(0, self.n, _BLOCK)]
            points_m, origin = _take_together(list(self.blocks(chosen)))
            near = np.argsort(first[origin])
            yield Samples(points_m[near], origin[near], None)


def _overlap(places: Array, runs: int) -> bool:
    """Return whether boxes around runs of consecutive places (N, 3) overlap more than in an order by space."""
    whole = np.ptp(places, axis=0)
    thickness = 0.01 * float(whole.max())  # at least; a plane has none
    boxes = [np.prod(np.ptp(run, axis=0) + thickness) for run in np.array_split(places, runs)]
    return float(np.sum(boxes)) > 2 * float(np.prod(whole + thickness))


def _take_together(some: list[Samples]) -> tuple[Array, IntArray]:
    """Return points and origins of several blocks, and take them off the list so that they are not there twice."""
    points_m = np.concatenate([block.points_m for block in some])
    origin = np.concatenate([block.origin for block in some])
    some.clear()
    return points_m, origin


def sample(surface: Surface, spacing_m: float, rng: np.random.Generator) -> Samples:
    """Return all samples of a surface at once. Raises as BlockedSamples."""
    blocks = list(BlockedSamples(surface, spacing_m, rng).blocks())
    normals = [block.normals for block in blocks if block.normals is not None]
    return Samples(
        np.concatenate([block.points_m for block in blocks]),
        np.concatenate([block.origin for block in blocks]),
        np.concatenate(normals) if normals else None,
    )


def _counts(surface: Surface, spacing_m: float, rng: np.random.Generator) -> IntArray:
    """Return (F,) number of samples on each face and those before it."""
    area = surface.face_areas_m2
    total = area.sum() / spacing_m**2
    if not total > 0:
        raise ComputeError("the mesh has no area", remedy="Export it again")
    if total > MOST_SAMPLES:
        raise ComputeError(
            f"{1e4 * area.sum():.0f} cm² at a spacing of {mm(spacing_m):g} mm are {total:.2g} points, more than "
            f"{MOST_SAMPLES:.0e}",
            remedy="Check the unit of the mesh, cut it to what is to be compared, or choose a larger spacing",
        )
    upto = np.floor(np.cumsum(area) / spacing_m**2 + rng.random()).astype(np.int64)
    if upto[-1] == 0:  # less than one cell of area
        upto[int(area.argmax()) :] = 1
    return upto


def random_points(surface: Surface, n: int, rng: np.random.Generator) -> Array:
    """Return (n, 3) points of a mesh, independent of one another and uniform in area."""
    share = np.cumsum(surface.face_areas_m2)
    chosen = np.searchsorted(share, rng.random(n) * share[-1], side="right")
    return random_places(surface, np.minimum(chosen, len(share) - 1), rng)


def normals_at(surface: Surface, origin: IntArray) -> Array | None:
    """Return unit normals (K, 3) of samples of this origin (K,); None if the surface is a cloud without normals."""
    if surface.is_mesh:
        return surface.normals_of(origin)
    return None if surface.normals is None else surface.normals[origin]


def random_places(surface: Surface, faces: IntArray, rng: np.random.Generator) -> Array:
    """Return (K, 3) one random point on each of these faces (K,)."""
    return _places(surface, faces, rng.random((2, len(faces))))


def _places(surface: Surface, faces: IntArray, drawn: Array) -> Array:
    """Return (K, 3) the point on each of these faces (K,) that two numbers drawn from 0 to 1 (2, K) stand for."""
    out = np.empty((len(faces), 3))
    for begin in range(0, len(faces), _PLACES):
        of, (u, v) = faces[begin : begin + _PLACES], drawn[:, begin : begin + _PLACES]
        folded = u + v > 1
        u, v = np.where(folded, 1 - u, u), np.where(folded, 1 - v, v)
        first, last = int(of.min()), int(of.max())
        if last - first < len(of):  # samples of few faces in a row: each face's edges are computed once
            corners, at = surface.faces[first : last + 1], of - first
        else:
            corners, at = surface.faces[of], None
        a, b, c = (surface.vertices_m[corners[:, k]] for k in range(3))
        for k in range(3):
            one, other, third = a[:, k], b[:, k] - a[:, k], c[:, k] - a[:, k]
            if at is not None:
                one, other, third = one[at], other[at], third[at]
            out[begin : begin + _PLACES, k] = one + u * other + v * third
    return out


def _thinned(surface: Surface, spacing_m: float) -> Samples:
    points = surface.vertices_m
    if len(points) == 0:
        raise ComputeError("the point cloud has no points", remedy="Export it again")
    cells = np.floor((points - points.min(axis=0)) / spacing_m).astype(np.int64)
    extent = cells.max(axis=0) + 1
    key = (cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]
    kept = np.sort(np.unique(key, return_index=True)[1]).astype(np.int64)
    return Samples(points[kept], kept, None if surface.normals is None else surface.normals[kept])


# The Chamfer distance of the paper between two surfaces, and the usual scores beside it.
#
# Source of the definition: Most et al., "Acquiring Submillimeter-Accurate Multi-Task Vision Datasets for Computer-
# Assisted Orthopedic Surgery", supplement, "Evaluation": both surfaces are sampled with a spacing of 0.1 mm,
# distances beyond 20 mm are excluded, and the means of the two directions are averaged.


SPACING_M = 1e-4
OUTLIER_M = 0.02
F_THRESHOLDS_M = (5e-4, 1e-3)
_AROUND = 12  # neighbours of a point on a surface
CHECKED = 100_000  # samples, taken at random, for the floor, the distance to the faces and the normals
# Samples of one surface whose distances are measured, taken at random if there are more. The other surface keeps all
# of its samples, so each distance stays the paper's; their mean gets a standard error of 1/1400 of their spread.
MOST_COMPARED = 2_000_000
_PREVIEW = 10  # of so many of them, one is looked at first: a good bound makes the search much faster


@dataclass(frozen=True, slots=True)
class ChamferSettings:
    """The settings by which two surfaces are compared; the defaults are the paper's.

    `to_faces`: also measure the distances to the faces, which takes most of the time with large meshes.
    `of_vertices`: also measure those of the vertices of the surface that is judged, for a heat map of it.
    """

    spacing_m: float = SPACING_M
    outlier_m: float = OUTLIER_M
    thresholds_m: tuple[float, ...] = F_THRESHOLDS_M
    seed: int = 0
    to_faces: bool = True
    of_vertices: bool = False


@dataclass(frozen=True, slots=True)
class Direction:
    """The distances from the samples of one surface to the other.

    Attributes:
        n: samples whose distances were measured, MOST_COMPARED at most.
        excluded: number of these farther than the outlier limit; in no mean, but in the denominator of `within`.
        mean_m: mean distance to the nearest sample of the other surface, which the paper reports.
        median_m, p95_m: median and 95th percentile of the same distances.
        within: share of all samples that have the other surface within each threshold.
        floor_m: mean distance from a random place of the other surface to its own nearest sample: what `mean_m`
            would be if the surfaces were equal.
        surface_mean_m, surface_rms_m: mean and root mean square of the distances to the other's faces (exact, of
            `CHECKED` samples at most); None if the other is a cloud, or if they were not asked for.
        normal_consistency: mean |cosine| between the normals of a sample and its nearest; None without normals.
    """

    n: int
    excluded: int
    mean_m: float
    median_m: float
    p95_m: float
    within: tuple[float, ...]
    floor_m: float
    surface_mean_m: float | None
    surface_rms_m: float | None
    normal_consistency: float | None


@dataclass(frozen=True, slots=True)
class DistanceSamples:
    """Samples of one surface, with the distance (N,) of each to the other's samples, infinite beyond the limit."""

    samples: Samples = field(repr=False)
    distance_m: Array = field(repr=False)


@dataclass(frozen=True, slots=True)
class ChamferScore:
    """The result of a comparison of two surfaces.

    Attributes:
        pred_to_gt: accuracy: from the surface judged to the truth.
        gt_to_pred: completeness: from the truth to the surface judged.
        thresholds_m: distance thresholds of the F-score.
        pred, gt: the samples with their distances.
        vertex_distance_m: (V,) distances from the vertices of the surface judged to the samples of the truth,
            infinite beyond the limit; None if not asked for.
    """

    pred_to_gt: Direction
    gt_to_pred: Direction
    thresholds_m: tuple[float, ...]
    pred: DistanceSamples = field(repr=False)
    gt: DistanceSamples = field(repr=False)
    vertex_distance_m: Array | None = field(default=None, repr=False)

    @property
    def chamfer_m(self) -> float:
        """Mean of the two directions' means."""
        return 0.5 * (self.pred_to_gt.mean_m + self.gt_to_pred.mean_m)

    @property
    def floor_m(self) -> float:
        """The `chamfer_m` that the sampling alone would give if the surfaces were equal."""
        return 0.5 * (self.pred_to_gt.floor_m + self.gt_to_pred.floor_m)

    @property
    def f_scores(self) -> tuple[float, ...]:
        """Harmonic mean of precision and recall for each threshold; 0 if both are 0."""
        pairs = zip(self.pred_to_gt.within, self.gt_to_pred.within, strict=True)
        return tuple(2 * p * r / (p + r) if p + r > 0 else 0.0 for p, r in pairs)


def chamfer(pred: Surface, gt: Surface, settings: ChamferSettings | None = None) -> ChamferScore:
    """Compare a surface with the truth; both in the same frame, in metres.

    Raises:
        ComputeError: a surface has no area or needs too many samples, or all of one is beyond the outlier limit.
    """
    chosen = settings or ChamferSettings()
    rng = np.random.default_rng(chosen.seed)
    a, b = BlockedSamples(pred, chosen.spacing_m, rng), BlockedSamples(gt, chosen.spacing_m, rng)
    places_a, places_b = _floor_places(pred, a, rng), _floor_places(gt, b, rng)
    of_a, of_b = _compared(a, chosen.seed), _compared(b, chosen.seed)
    vertices = pred.vertices_m if chosen.of_vertices else np.empty((0, 3))
    to_b, floor_b, of_vertices = _nearest(b, of_b, (of_a.points_m, places_b, vertices), chosen.outlier_m)
    to_a, floor_a, _ = _nearest(a, of_a, (of_b.points_m, places_a, np.empty((0, 3))), chosen.outlier_m)
    forth = _direction(_Way(pred, of_a, gt, b, to_b), _mean(floor_b), chosen, rng)
    back = _direction(_Way(gt, of_b, pred, a, to_a), _mean(floor_a), chosen, rng)
    return ChamferScore(
        forth,
        back,
        chosen.thresholds_m,
        DistanceSamples(of_a, to_b.distance_m),
        DistanceSamples(of_b, to_a.distance_m),
        of_vertices.distance_m if chosen.of_vertices else None,
    )


def _compared(samples: BlockedSamples, seed: int) -> Samples:
    """Select the samples whose distances are measured: all, or MOST_COMPARED at random, the same share of a block."""
    rng = np.random.default_rng([seed, samples.n])  # of its own: the other draws do not depend on it
    share = min(1.0, MOST_COMPARED / samples.n)
    some: list[IntArray] | None = None
    if share < 1:
        some = [np.sort(rng.choice(n, int(np.floor(share * n)), replace=False)) for n in samples.sizes]
    kept = list(samples.blocks(some))
    all_normals = [block.normals for block in kept if block.normals is not None]
    return Samples(
        np.concatenate([block.points_m for block in kept]),
        np.concatenate([block.origin for block in kept]),
        np.concatenate(all_normals) if all_normals else None,
    )


def _nearest(
    targets: BlockedSamples, some: Samples, queries: tuple[Array, Array, Array], outlier_m: float
) -> tuple[NearestOfBlocks, NearestOfBlocks, NearestOfBlocks]:
    """Find the nearest of all samples of a surface for three sets of queries (Q, 3), by their face or point.

    The second set lies on that surface itself, and has no limit. `some` of the samples are looked at first.
    """
    one, own, other = queries
    found = NearestOfBlocks(one, outlier_m), NearestOfBlocks(own), NearestOfBlocks(other, outlier_m)
    first = Samples(some.points_m[::_PREVIEW], some.origin[::_PREVIEW], None)
    for block in chain([first] if targets.n > MOST_COMPARED else [], targets.regions()):
        show(block.points_m, block.origin, found)
    return found


def _mean(nearest: NearestOfBlocks) -> float:
    return float(nearest.distance_m.mean()) if len(nearest.distance_m) else 0.0


@dataclass(frozen=True, slots=True)
class _Way:
    """The samples of one surface with the nearest of all samples of another."""

    source: Surface
    samples: Samples
    target: Surface
    targets: BlockedSamples
    nearest: NearestOfBlocks

    @property
    def distance(self) -> Array:
        return self.nearest.distance_m


def _direction(way: _Way, floor_m: float, settings: ChamferSettings, rng: np.random.Generator) -> Direction:
    near = np.isfinite(way.distance)
    if not near.any():
        apart = NearestOfBlocks(way.samples.points_m)
        for block in way.targets.blocks():
            show(block.points_m, block.origin, (apart,))
        raise ComputeError(
            f"no point lies within {mm(settings.outlier_m):g} mm of the other surface; the nearest is "
            f"{mm(float(apart.distance_m.min())):.4g} mm away",
            remedy="Check that both are in the same frame and that their units are right",
        )
    kept = way.distance[near]
    median, p95 = np.percentile(kept, [50, 95])
    chosen = np.flatnonzero(near)
    if len(chosen) > CHECKED:
        chosen = np.sort(rng.choice(chosen, CHECKED, replace=False))
    surface = _to_faces(way, chosen) if settings.to_faces else None
    return Direction(
        n=len(way.distance),
        excluded=int(np.count_nonzero(~near)),
        mean_m=float(kept.mean()),
        median_m=float(median),
        p95_m=float(p95),
        within=tuple(float(np.mean(way.distance <= limit)) for limit in settings.thresholds_m),
        floor_m=floor_m,
        surface_mean_m=None if surface is None else float(surface.mean()),
        surface_rms_m=None if surface is None else float(np.sqrt(np.mean(surface**2))),
        normal_consistency=_consistency(way, chosen),
    )


def _to_faces(way: _Way, chosen: IntArray) -> Array | None:
    if not way.target.is_mesh:
        return None
    return TriangleTree(way.target).nearest(way.samples.points_m[chosen], way.distance[chosen]).distance_m


def _consistency(way: _Way, chosen: IntArray) -> float | None:
    a = normals_at(way.source, way.samples.origin[chosen])
    b = normals_at(way.target, way.nearest.label[chosen])
    return None if a is None or b is None else float(np.abs(np.einsum("ni,ni->n", a, b)).mean())


def _floor_places(surface: Surface, samples: BlockedSamples, rng: np.random.Generator) -> Array:
    """Return random places (N, 3) of a surface, whose mean distance from its nearest samples is the floor."""
    n = min(CHECKED, samples.n)
    if surface.is_mesh:
        return random_points(surface, n, rng)
    if samples.n <= _AROUND:
        return np.empty((0, 3))
    # A cloud's surface is unknown: the plane through a point's neighbours, as far as these reach, stands for it.
    points = np.concatenate([block.points_m for block in samples.blocks()])
    chosen = points[rng.choice(len(points), n, replace=False)]
    around = points[PointIndex(points).neighbours(chosen, _AROUND + 1)]
    axes = np.linalg.svd(around - around.mean(axis=1, keepdims=True), full_matrices=False)[2]
    reach = np.linalg.norm(around[:, -1] - chosen, axis=1) * np.sqrt(rng.random(n))
    angle = 2 * np.pi * rng.random(n)
    flat = np.stack([reach * np.cos(angle), reach * np.sin(angle)], axis=1)
    return chosen + np.einsum("nk,nki->ni", flat, axes[:, :2])
