"""The Chamfer distance of the paper between two surfaces, and the usual scores beside it.

Source of the definition: Most et al., "Acquiring Submillimeter-Accurate Multi-Task Vision Datasets for
Computer-Assisted Orthopedic Surgery", supplement, "Evaluation": both surfaces are sampled with a spacing of 0.1 mm,
distances beyond 20 mm are excluded, and the means of the two directions are averaged.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from service.compute.ground_truth.distances.neighbours import PointIndex
from service.compute.ground_truth.distances.sampling import Samples, normals_of, random_points, sample
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


@dataclass(frozen=True, slots=True)
class ChamferSettings:
    """How two surfaces are compared; the defaults are the paper's.

    `to_faces`: also measure the distances to the faces, which takes most of the time with large meshes.
    """

    spacing_m: float = SPACING_M
    outlier_m: float = OUTLIER_M
    thresholds_m: tuple[float, ...] = F_THRESHOLDS_M
    seed: int = 0
    to_faces: bool = True


@dataclass(frozen=True, slots=True)
class Direction:
    """The distances from the samples of one surface to the other.

    Attributes:
        n: samples.
        excluded: samples farther than the outlier limit; in no mean, but in the denominator of `within`.
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
    """

    pred_to_gt: Direction
    gt_to_pred: Direction
    thresholds_m: tuple[float, ...]
    pred: DistanceSamples = field(repr=False)
    gt: DistanceSamples = field(repr=False)

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
    a, b = sample(pred, chosen.spacing_m, rng), sample(gt, chosen.spacing_m, rng)
    index_a, index_b = PointIndex(a.points_m), PointIndex(b.points_m)
    to_b, nearest_b = index_b.nearest(a.points_m, chosen.outlier_m)
    to_a, nearest_a = index_a.nearest(b.points_m, chosen.outlier_m)
    floor_a, floor_b = _floor(pred, a, index_a, rng), _floor(gt, b, index_b, rng)
    forth = _direction(_Way(pred, a, gt, b, to_b, nearest_b), floor_b, chosen, rng)
    back = _direction(_Way(gt, b, pred, a, to_a, nearest_a), floor_a, chosen, rng)
    return ChamferScore(forth, back, chosen.thresholds_m, DistanceSamples(a, to_b), DistanceSamples(b, to_a))


@dataclass(frozen=True, slots=True)
class _Way:
    """From the samples of one surface to another: distance (N,), infinite if too far, and nearest sample (N,)."""

    source: Surface
    samples: Samples
    target: Surface
    targets: Samples
    distance: Array
    nearest: IntArray


def _direction(way: _Way, floor_m: float, settings: ChamferSettings, rng: np.random.Generator) -> Direction:
    near = np.isfinite(way.distance)
    if not near.any():
        apart = PointIndex(way.targets.points_m).nearest(way.samples.points_m)[0]
        raise ComputeError(
            f"no point lies within {mm(settings.outlier_m):g} mm of the other surface; the nearest is "
            f"{mm(float(apart.min())):.4g} mm away",
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
    a = normals_of(way.source, way.samples, chosen)
    b = normals_of(way.target, way.targets, way.nearest[chosen])
    return None if a is None or b is None else float(np.abs(np.einsum("ni,ni->n", a, b)).mean())


def _floor(surface: Surface, samples: Samples, index: PointIndex, rng: np.random.Generator) -> float:
    """Mean distance from random places of a surface to its nearest sample."""
    n = min(CHECKED, len(samples.points_m))
    if surface.is_mesh:
        return float(index.nearest(random_points(surface, n, rng))[0].mean())
    if len(samples.points_m) <= _AROUND:
        return 0.0
    # A cloud's surface is unknown: the plane through a point's neighbours, as far as these reach, stands for it.
    chosen = samples.points_m[rng.choice(len(samples.points_m), n, replace=False)]
    around = samples.points_m[index.neighbours(chosen, _AROUND + 1)]
    axes = np.linalg.svd(around - around.mean(axis=1, keepdims=True), full_matrices=False)[2]
    reach = np.linalg.norm(around[:, -1] - chosen, axis=1) * np.sqrt(rng.random(n))
    angle = 2 * np.pi * rng.random(n)
    flat = np.stack([reach * np.cos(angle), reach * np.sin(angle)], axis=1)
    return float(index.nearest(chosen + np.einsum("nk,nki->ni", flat, axes[:, :2]))[0].mean())
