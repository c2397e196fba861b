"""Fuses a CT mesh and a scan, in one frame, into one mesh: the CT in the wound, the scan elsewhere, no step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import LinearOperator, cg

from service.compute.surfaces.overlap import (
    Mask,
    OverlapLimits,
    Region,
    RegionCorrection,
    WoundLimits,
    components,
    corrected,
    distance_to,
    overlap,
    propose_wound,
)
from service.compute.surfaces.surface import FACES, IntArray, PointIndex, Surface
from service.core.errors import ComputeError
from service.core.geometry import Array, place_jacobian

_ITERATIONS, _RELATIVE = 2000, 1e-3
_FACES = 500_000  # whose edges are sorted at a time, which limits the memory
_AVERAGED = 4  # times in each attempt
_ALIKE = (1, 1, 2)  # rings of neighbours around faces that turn over: in them, moves become alike
_ROUNDED = (0,) * 10  # then their own corners are evened out
_STIFF = (
    1,
    1,
    2,
    2,
    4,
    4,
    8,
    8,
    16,
    16,
    32,
    32,
    64,
    64,
)  # at last they move as one piece; over so many rings, into the rest


@dataclass(frozen=True, slots=True)
class FieldLengths:
    """The lengths that make the field smooth.

    Attributes:
        smoothing_m: length over which the field averages the scan's noise.
        reach_m: length over which it decays where the scan shows nothing.
    """

    smoothing_m: float = 0.0007
    reach_m: float = 0.006


def _deviation_field(
    surface: Surface, links: csr_matrix, known_m: Array, known: Mask, lengths: FieldLengths
) -> Array:
    """Return (V,) metres that follow `known_m` where it is `known`, and decay from there along the surface.

    It minimises the squared differences over the edges, with weights towards the known values and, elsewhere, 0.

    Args:
        surface: a mesh.
        links: its `_adjacency`.
        known_m: (V,) deviations, along the normals.
        known: (V,) where they count.
        lengths: the lengths of smoothing and decay.

    Raises:
        ComputeError: the solver does not converge.
    """
    edge_m = _usual_edge(surface)
    pull = np.where(known, (edge_m / lengths.smoothing_m) ** 2, (edge_m / lengths.reach_m) ** 2)
    diagonal = np.asarray(links.sum(axis=1)).ravel() + pull
    wanted = np.where(known, pull * known_m, 0.0)
    n = len(wanted)
    matrix = LinearOperator((n, n), matvec=lambda x: diagonal * x - links @ x, dtype=np.float64)
    inverse = LinearOperator((n, n), matvec=lambda x: x / diagonal, dtype=np.float64)
    field, left = cg(matrix, wanted, rtol=_RELATIVE, maxiter=_ITERATIONS, M=inverse)
    if left != 0:
        raise ComputeError("the deviation of the CT from the scan has no smooth field", remedy="Check both meshes")
    return np.asarray(field, dtype=np.float64)


def moved_unfolded(surface: Surface, move_m: Array, known: csr_matrix | None = None) -> tuple[Surface, int]:
    """Return the surface after a displacement (V, 3) of its vertices, and the number of faces that are turned over.

    Around faces that turn over (mostly slivers of marching cubes), displacements are averaged with those of their
    neighbours: equal displacements turn no face. Where that is not enough, vertices move to the mean of their
    neighbours. Faces that still turn over move as one piece with what is around them. `known` is the surface's
    `_adjacency`, if it was computed before.
    """
    points = surface.vertices_m + move_m
    folded = _folded(surface, points, np.arange(len(surface.faces)))
    if not len(folded):
        return Surface(points, surface.faces), 0
    links = _adjacency(surface) if known is None else known
    means: csr_matrix = (diags(1 / np.maximum(np.asarray(links.sum(axis=1)).ravel(), 1.0)) @ links).tocsr()
    for rings in (*_ALIKE, *_ROUNDED):
        around = np.zeros(len(points))
        around[surface.faces[folded].ravel()] = 1.0
        for _ in range(rings):
            around += links @ around
        chosen = np.flatnonzero(around)
        mean = means[chosen]
        fixed = surface.vertices_m if rings else np.zeros_like(points)
        for _ in range(_AVERAGED):
            move = points - fixed
            points[chosen] = fixed[chosen] + 0.5 * (move[chosen] + mean @ move)
        folded = _folded(surface, points, np.flatnonzero(surface.touching(around > 0)))  # the others lie as before
        if not len(folded):
            return Surface(points, surface.faces), 0
    still = folded
    for rings in _STIFF:
        share, piece = _pieces(surface, links, folded, rings)
        move = points - surface.vertices_m
        whole = np.maximum(np.bincount(piece, share), 1.0)  # 0 for vertices of no piece, whose share is 0 too
        mean = np.stack([np.bincount(piece, share * move[:, k]) / whole for k in range(3)], axis=1)
        points = points + share[:, None] * (mean[piece] - move)
        still = _folded(surface, points, np.flatnonzero(surface.touching(share > 0)))
        if not len(still):
            return Surface(points, surface.faces), 0
        folded = np.union1d(folded, still)  # those that lie straight now stay in their pieces
    return Surface(points, surface.faces), len(still)


def _pieces(surface: Surface, links: csr_matrix, folded: IntArray, rings: int) -> tuple[Array, IntArray]:
    """Return (V,) share with which each vertex moves as a part of its piece, and (V,) the piece's number.

    The share is 1 at the corners of the folded faces and their neighbours, and passes to 0 over `rings` rings.
    """
    near = np.zeros(len(surface.vertices_m), dtype=bool)
    near[surface.faces[folded].ravel()] = True
    share = near.astype(np.float64)
    for ring in range(rings + 1):
        near |= links @ near.astype(np.float64) > 0
        share = np.maximum(share, np.where(near, 1.0 - ring / (rings + 1), 0.0))
    inside = diags(near.astype(np.float64))
    return share, np.asarray(connected_components(inside @ links @ inside, directed=False)[1], dtype=np.int64)


def _adjacency(surface: Surface) -> csr_matrix:
    """Return (V, V) 1 for each pair of vertices with an edge between them."""
    f, n = surface.faces, len(surface.vertices_m)
    begun = np.zeros(n + 1, dtype=np.int64)
    for k in range(3):
        np.add.at(begun, f[:, k] + 1, 2)  # each face gives each of its corners two neighbours
    np.cumsum(begun, out=begun)
    neighbours = np.empty(int(begun[-1]), dtype=np.int32)
    filled = begun[:-1].copy()
    for begin in range(0, len(f), _FACES):
        part = f[begin : begin + _FACES]
        one = np.concatenate([part[:, [0, 1, 2]].ravel(), part[:, [0, 1, 2]].ravel()])
        other = np.concatenate([part[:, [1, 2, 0]].ravel(), part[:, [2, 0, 1]].ravel()])
        order = np.argsort(one, kind="stable")
        one, other = one[order], other[order]
        vertex, start, count = np.unique(one, return_index=True, return_counts=True)
        neighbours[filled[one] + np.arange(len(one)) - np.repeat(start, count)] = other
        filled[vertex] += count
    links = csr_matrix((np.ones(len(neighbours), dtype=np.float32), neighbours, begun.astype(np.int32)), shape=(n, n))
    links.sum_duplicates()  # an edge of two faces is there twice
    return csr_matrix((np.ones(links.nnz), links.indices, links.indptr), shape=(n, n))


def _usual_edge(surface: Surface) -> float:
    lengths = np.empty(len(surface.faces))
    for block in surface.blocks():
        ends = surface.vertices_m[surface.faces[block, :2]]
        lengths[block] = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    return float(np.median(lengths))


def _folded(surface: Surface, points_m: Array, of: IntArray) -> IntArray:
    """Select faces whose normal turns by more than a right angle when the vertices move to these points."""
    moved = Surface(points_m, surface.faces)
    folded = np.empty(len(of), dtype=np.bool_)
    for begin in range(0, len(of), FACES):
        part = slice(begin, begin + FACES)
        after, before = moved.area_vectors_of(of[part]), surface.area_vectors_of(of[part])
        folded[part] = np.einsum("fi,fi->f", after, before) < 0
    return of[folded]


# The triangulation of the CT carries the result, which is watertight where the CT is. Its vertices move onto the
# scan by a weight that rises smoothly from 0 to 1 over the overlap. Where the CT deviates from the scan beside the
# seam, its part on the other side follows, by less and less with the distance: so there is no step. What the scan
# shows beyond that smooth deviation is mostly its noise, and comes in later.


_DETAIL_FROM = 0.3  # of the overlap: from here on the scan's own detail comes in
_VERTICES = 200_000  # computed at a time, which limits the memory


class Source(IntEnum):
    """The origin of a vertex."""

    CT = 0
    SCAN = 1
    BLEND = 2


@dataclass(frozen=True, slots=True)
class FusionSettings:
    """The settings of the fusion of two meshes.

    Attributes:
        blend_m: width of the overlap over which the weight rises.
        sigma_ct_m, sigma_scan_m: least standard deviation of each surface along its normal, as of its spheres.
        alignment_covariance: (6, 6) covariance of T_scan_ct as in `evaluation.error_budget.Alignment`; None: known
            exactly.
        keep_scan_only: true to add parts of the scan that are missing in the CT, unconnected.
        least_part_m2: smaller unconnected parts of the CT are left out.
        overlap, wound: limits.
        lengths: lengths of the field by which the CT follows the scan.
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
    """The fused ground-truth mesh, with the source, weight and noise of each vertex.

    Attributes:
        surface: the fused mesh, in the frame of the sources.
        source: (V,) the Source of each vertex.
        weight: (V,) weight of the scan, 0 to 1.
        sigma_m: (V,) standard deviation along the normal.
        wound: (V,) true in the wound region, as proposed and corrected.
        ct_offset_m: median height of the CT above the scan, outside the wound: its bias if the scan is right.
        ct_spread_m: robust standard deviation of the same heights.
        folded: number of faces that could not be prevented from turning over when their vertices moved.
        corrections: the corrections that were applied.
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
        """Return the share of the vertices from this source."""
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
        ct: the CT's mesh in the scan's frame, vertices shared between faces, outward faces.
        scan: the scan's mesh; where it has holes, and in the wound, the CT is taken.
        up: (3,) direction away from the table; it distinguishes hollows from undersides.
        settings: the defaults if None.
        corrections: regions that people drew.
        removed: region where the CT shows something that was taken away before the scan; there only the scan counts.

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
    links = _adjacency(carrier)
    followed = _deviation_field(carrier, links, known_m, usable, chosen.lengths)[:, None] * carrier.vertex_normals
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
    """Rise from 0 at 0 and below to 1 at 1 and beyond, with continuous curvature between."""
    t = np.clip(x, 0.0, 1.0)
    return t**3 * (10 + t * (6 * t - 15))


def _sigma(carrier: Surface, weight: Array, gap: Array, sigma_ct_m: float, settings: FusionSettings) -> Array:
    """Return (V,) standard deviation along the normal; where both count, their disagreement does, too."""
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
    """Return the CT without small unconnected parts (noise) and without vertices that no face has."""
    if not ct.is_mesh:
        raise ComputeError("fusion needs a mesh of the CT", remedy="Extract its surface first")
    if least_m2 <= 0:
        return compact(ct.vertices_m, ct.faces)[0]
    labels = components(ct, np.ones(len(ct.vertices_m), dtype=np.bool_))
    part = labels[ct.faces[:, 0]]
    area = np.bincount(part, ct.face_areas_m2)
    return compact(ct.vertices_m, ct.faces[area[part] >= least_m2])[0]


def outside(surface: Surface, region: Region) -> Surface:
    """Return the surface without the faces that touch a region."""
    inside = region.contains(surface.vertices_m)
    if not inside.any():
        return compact(surface.vertices_m, surface.faces)[0]
    return compact(surface.vertices_m, surface.faces[~surface.touching(inside)])[0]


def compact(vertices: Array, faces: IntArray) -> tuple[Surface, IntArray]:
    """Return the mesh without vertices that no face has, and the former index (V,) of each that is left."""
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
        """Return (F,) faces of the scan that are far from the CT, or touch what was taken away since."""
        far_m = 2 * self.settings.overlap.distance_m
        vertices = self.scan.vertices_m
        far = PointIndex(carrier.vertices_m).nearest(vertices, far_m)[0] > far_m
        taken: Mask = ~self.scan.touching(~far)
        if self.removed is not None:
            taken |= self.scan.touching(self.removed.contains(vertices))
        return taken


def _with_scan_only(fused: Fused, carrier: Surface, addition: _Addition) -> Fused:
    """Add the faces of the scan missing in the CT, as separate parts."""
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


@dataclass(frozen=True, slots=True)
class Markers:
    """Spheres on posts, in the frame of the mesh.

    Attributes:
        centres_m: (M, 3) the spheres' centres.
        radius_m: radius of the spheres.
        up: (3,) along the posts, away from the table.
        post_radius_m: radius of the posts; 0: there are none.
        post_length_m: length of the posts below the centres.
        margin_m: width that is cut away around both.
    """

    centres_m: Array
    radius_m: float
    up: Array
    post_radius_m: float = 0.0
    post_length_m: float = 0.2
    margin_m: float = 0.002

    def near(self, points_m: Array) -> Mask:
        """Return (N,) which points (N, 3) are on a sphere or a post, or within the margin of one."""
        up = self.up / np.linalg.norm(self.up)
        out = np.zeros(len(points_m), dtype=np.bool_)
        for centre in self.centres_m:
            way = points_m - centre
            along = way @ up
            out |= np.linalg.norm(way, axis=1) <= self.radius_m + self.margin_m
            if self.post_radius_m > 0:
                aside = np.linalg.norm(way - along[:, None] * up, axis=1)
                out |= (aside <= self.post_radius_m + self.margin_m) & (along < 0) & (along > -self.post_length_m)
        return out


def without_markers(fused: Fused, markers: Markers) -> Fused:
    """Return the ground truth without the faces that touch a sphere or a post; where they stood it is open."""
    near = markers.near(fused.surface.vertices_m)
    surface, kept = compact(fused.surface.vertices_m, fused.surface.faces[~fused.surface.touching(near)])
    return replace(
        fused,
        surface=surface,
        source=fused.source[kept],
        weight=fused.weight[kept],
        sigma_m=fused.sigma_m[kept],
        wound=fused.wound[kept],
    )
