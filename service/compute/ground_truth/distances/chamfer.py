"""The Chamfer distance of the paper between two surfaces, and the usual scores beside it.

Source of the definition: Most et al., "Acquiring Submillimeter-Accurate Multi-Task Vision Datasets for
Computer-Assisted Orthopedic Surgery", supplement, "Evaluation": both surfaces are sampled with a spacing of 0.1 mm,
distances beyond 20 mm are excluded, and the means of the two directions are averaged.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import chain

import numpy as np

from service.compute.ground_truth.distances.neighbours import NearestOfBlocks, PointIndex, show
from service.compute.ground_truth.distances.sampling import BlockedSamples, Samples, normals_at, random_points
from service.compute.ground_truth.distances.triangle_tree import TriangleTree
from service.compute.ground_truth.surface import IntArray, Surface
from service.core.errors import ComputeError
from service.core.geometry import Array
from service.core.units import mm

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
    """How two surfaces are compared; the defaults are the paper's.

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
        excluded: of these, those farther than the outlier limit; in no mean, but in the denominator of `within`.
        mean_m: mean distance to the nearest sample of the other surface: the paper's figure.
        median_m, p95_m: of the same distances.
        within: for each threshold, the share of all samples that have the other surface within it.
        floor_m: mean distance from a random place of the other surface to its own nearest sample: what `mean_m`
            would be if the surfaces were equal.
        surface_mean_m, surface_rms_m: of the distances to the other's faces (exact, of `CHECKED` samples at most);
            None if the other is a cloud, or if they were not asked for.
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
    """Two surfaces compared.

    Attributes:
        pred_to_gt: accuracy: from the surface judged to the truth.
        gt_to_pred: completeness: from the truth to the surface judged.
        thresholds_m: of the F-score.
        pred, gt: the samples with their distances.
        vertex_distance_m: (V,) from the vertices of the surface judged to the samples of the truth, infinite beyond
            the limit; None if not asked for.
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
        """What `chamfer_m` would be, by the sampling alone, if the surfaces were equal."""
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
    """The samples whose distances are measured: all, or MOST_COMPARED at random, the same share of each block."""
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
    """The nearest of all samples of a surface for three sets of queries (Q, 3), by the face or point they are on.

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
    """From samples of one surface to the nearest of all samples of another."""

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
    """Random places (N, 3) of a surface, whose mean distance from its nearest samples is the floor."""
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
