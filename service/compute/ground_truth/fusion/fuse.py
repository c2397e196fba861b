"""Fuses a CT mesh and a scan, in one frame, into one mesh: the CT in the wound, the scan elsewhere, no step between.

The triangulation of the CT carries the result, which is watertight where the CT is. Its vertices move onto the scan
by a weight that rises smoothly from 0 to 1 over the overlap. Where the CT deviates from the scan beside the seam, its
part on the other side follows, by less and less with the distance: so there is no step. What the scan shows beyond
that smooth deviation is mostly its noise, and comes in later.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from service.compute.ground_truth.distances.neighbours import PointIndex
from service.compute.ground_truth.fusion.deviation import FieldLengths, adjacency, deviation_field, moved_unfolded
from service.compute.ground_truth.fusion.overlap import (
    Mask,
    OverlapLimits,
    WoundLimits,
    components,
    distance_to,
    overlap,
    propose_wound,
)
from service.compute.ground_truth.fusion.regions import Region, RegionCorrection, corrected
from service.compute.ground_truth.surface import IntArray, Surface
from service.core.errors import ComputeError
from service.core.geometry import Array, place_jacobian

_DETAIL_FROM = 0.3  # of the overlap: from here on the scan's own detail comes in
_VERTICES = 200_000  # computed at a time, which limits the memory


class Source(IntEnum):
    """Where a vertex comes from."""

    CT = 0
    SCAN = 1
    BLEND = 2


@dataclass(frozen=True, slots=True)
class FusionSettings:
    """How two meshes are fused.

    Attributes:
        blend_m: width of the overlap over which the weight rises.
        sigma_ct_m, sigma_scan_m: least standard deviation of each surface along its normal, as of its spheres.
        alignment_covariance: (6, 6) of T_scan_ct as in `evaluation.closure.Alignment`; None: known exactly.
        keep_scan_only: whether parts of the scan that the CT lacks are added, unconnected.
        least_part_m2: smaller unconnected parts of the CT are left out.
        overlap, wound: limits.
        lengths: of the field by which the CT follows the scan.
    """

    blend_m: float = 0.003
    sigma_ct_m: float = 1.0e-4
    sigma_scan_m: float = 5.0e-5
    alignment_covariance: Array | None = field(default=None, repr=False)
    keep_scan_only: bool = True
    least_part_m2: float = 2e-6
    overlap: OverlapLimits = field(default_factory=OverlapLimits)
    wound: WoundLimits = field(default_factory=WoundLimits)
    lengths: FieldLengths = field(default_factory=FieldLengths)


@dataclass(frozen=True, slots=True)
class Fused:
    """The ground truth.

    Attributes:
        surface: in the frame of the sources.
        source: (V,) of Source.
        weight: (V,) of the scan, 0 to 1.
        sigma_m: (V,) standard deviation along the normal.
        wound: (V,) in the wound region, as proposed and corrected.
        ct_offset_m: median height of the CT above the scan, outside the wound: its bias if the scan is right.
        ct_spread_m: robust standard deviation of the same heights.
        folded: faces that could not be kept from turning over when their vertices moved.
        corrections: that were applied.
    """

    surface: Surface
    source: NDArray[np.uint8] = field(repr=False)
    weight: Array = field(repr=False)
    sigma_m: Array = field(repr=False)
    wound: Mask = field(repr=False)
    ct_offset_m: float
    ct_spread_m: float
    folded: int
    corrections: tuple[RegionCorrection, ...]

    def share(self, source: Source) -> float:
        """Share of the vertices from this source."""
        return float(np.mean(self.source == source))


def fuse(
    ct: Surface,
    scan: Surface,
    up: Array,
    settings: FusionSettings | None = None,
    corrections: Sequence[RegionCorrection] = (),
    removed: Region | None = None,
) -> Fused:
    """Fuse a CT mesh and a scan.

    Args:
        ct: in the scan's frame, vertices shared between faces, outward faces.
        scan: where it has holes, and in the wound, the CT is taken.
        up: (3,) direction away from the table; it distinguishes hollows from undersides.
        settings: the defaults if None.
        corrections: regions that people drew.
        removed: where the CT shows something that was taken away before the scan; there only the scan counts.

    Raises:
        ComputeError: a source has no faces, or the two agree nowhere.
    """
    chosen = settings or FusionSettings()
    carrier = without_specks(ct if removed is None else outside(ct, removed), chosen.least_part_m2)
    seen = overlap(carrier, scan, chosen.overlap)
    if not seen.covered.any():
        raise ComputeError("CT and scan agree nowhere", remedy="Check that both are in the same frame and unit")
    wound = corrected(propose_wound(carrier, seen.covered, up, chosen.wound), carrier.vertices_m, corrections)
    usable = seen.covered & ~wound
    height = seen.offset_m[usable] if usable.any() else np.zeros(1)
    offset = float(np.median(height))
    spread = 1.4826 * float(np.median(np.abs(height - offset)))
    within = distance_to(carrier.vertices_m, ~usable, chosen.blend_m) / chosen.blend_m
    weight, detail = _smooth_step(within), _smooth_step((within - _DETAIL_FROM) / (1 - _DETAIL_FROM))
    known_m = np.where(usable, -seen.offset_m, 0.0)
    links = adjacency(carrier)
    followed = deviation_field(carrier, links, known_m, usable, chosen.lengths)[:, None] * carrier.vertex_normals
    onto = seen.nearest_m - carrier.vertices_m
    moved, folded = moved_unfolded(carrier, followed + detail[:, None] * (onto - followed), links)
    del links
    sigma = _sigma(carrier, weight, np.linalg.norm(onto - followed, axis=1), max(chosen.sigma_ct_m, spread), chosen)
    source = np.where(weight <= 0, Source.CT, np.where(weight >= 1, Source.SCAN, Source.BLEND)).astype(np.uint8)
    fused = Fused(
        moved,
        source,
        weight,
        sigma,
        wound,
        offset,
        spread,
        folded,
        tuple(corrections),
    )
    return _with_scan_only(fused, carrier, _Addition(scan, chosen, removed)) if chosen.keep_scan_only else fused


def _smooth_step(x: Array) -> Array:
    """0 up to 0, 1 from 1 on, with continuous curvature between."""
    t = np.clip(x, 0.0, 1.0)
    return t**3 * (10 + t * (6 * t - 15))


def _sigma(carrier: Surface, weight: Array, gap: Array, sigma_ct_m: float, settings: FusionSettings) -> Array:
    """(V,) standard deviation along the normal; where both count, their disagreement does, too."""
    ct = np.full(len(weight), sigma_ct_m**2)
    if settings.alignment_covariance is not None:
        normals = carrier.vertex_normals
        for begin in range(0, len(weight), _VERTICES):
            part = slice(begin, begin + _VERTICES)
            J = np.einsum("ni,nik->nk", normals[part], place_jacobian(carrier.vertices_m[part]))
            ct[part] += np.einsum("nk,kl,nl->n", J, settings.alignment_covariance, J)
    between = (weight * (1 - weight) * gap) ** 2
    return np.sqrt((weight * settings.sigma_scan_m) ** 2 + (1 - weight) ** 2 * ct + between)


def without_specks(ct: Surface, least_m2: float) -> Surface:
    """The CT without small unconnected parts (noise) and without vertices that no face has."""
    if not ct.is_mesh:
        raise ComputeError("fusion needs a mesh of the CT", remedy="Extract its surface first")
    if least_m2 <= 0:
        return compact(ct.vertices_m, ct.faces)[0]
    labels = components(ct, np.ones(len(ct.vertices_m), dtype=np.bool_))
    part = labels[ct.faces[:, 0]]
    area = np.bincount(part, ct.face_areas_m2)
    return compact(ct.vertices_m, ct.faces[area[part] >= least_m2])[0]


def outside(surface: Surface, region: Region) -> Surface:
    """The surface without the faces that touch a region."""
    inside = region.contains(surface.vertices_m)
    if not inside.any():
        return compact(surface.vertices_m, surface.faces)[0]
    return compact(surface.vertices_m, surface.faces[~surface.touching(inside)])[0]


def compact(vertices: Array, faces: IntArray) -> tuple[Surface, IntArray]:
    """The mesh without vertices that no face has, and the former index (V,) of each that is left."""
    used = np.zeros(len(vertices), dtype=np.bool_)
    used[faces.ravel()] = True
    kept = np.flatnonzero(used)
    if len(kept) == len(vertices):
        return Surface(vertices, faces), kept
    index = np.cumsum(used, dtype=faces.dtype) - faces.dtype.type(1)
    return Surface(vertices[kept], index[faces]), kept


@dataclass(frozen=True, slots=True)
class _Addition:
    scan: Surface
    settings: FusionSettings
    removed: Region | None

    def taken(self, carrier: Surface) -> Mask:
        """(F,) faces of the scan that are far from the CT, or touch what was taken away since."""
        far_m = 2 * self.settings.overlap.distance_m
        vertices = self.scan.vertices_m
        far = PointIndex(carrier.vertices_m).nearest(vertices, far_m)[0] > far_m
        taken: Mask = ~self.scan.touching(~far)
        if self.removed is not None:
            taken |= self.scan.touching(self.removed.contains(vertices))
        return taken


def _with_scan_only(fused: Fused, carrier: Surface, addition: _Addition) -> Fused:
    """Add the faces of the scan that the CT lacks, as separate parts."""
    scan, settings = addition.scan, addition.settings
    extra, _ = compact(scan.vertices_m, scan.faces[addition.taken(carrier)])
    n = len(extra.vertices_m)
    if n == 0:
        return fused
    return Fused(
        Surface(
            np.concatenate([fused.surface.vertices_m, extra.vertices_m]),
            np.concatenate([fused.surface.faces, extra.faces + len(fused.surface.vertices_m)]),
        ),
        np.concatenate([fused.source, np.full(n, Source.SCAN, dtype=np.uint8)]),
        np.concatenate([fused.weight, np.ones(n)]),
        np.concatenate([fused.sigma_m, np.full(n, settings.sigma_scan_m)]),
        np.concatenate([fused.wound, np.zeros(n, dtype=np.bool_)]),
        fused.ct_offset_m,
        fused.ct_spread_m,
        fused.folded,
        fused.corrections,
    )
