"""Points at an even density on a surface, the density being one point for each square of the spacing."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice

import numpy as np

from service.compute.ground_truth.distances.neighbours import z_order
from service.compute.ground_truth.surface import IntArray, Surface
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
        points_m: (N, 3).
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
        """All samples in order, in blocks of up to a million; the same ones each time.

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
        """All samples, those together that lie together, without normals; a region is larger than a block.

        In a file whose faces have no spatial order, each block is spread over the whole surface.
        """
        runs = -(-self.n // (_TOGETHER * _BLOCK))
        places = self._surface.vertices_m[self._surface.faces[:, 0]] if self._surface.is_mesh and runs > 1 else None
        if places is None or not _overlap(places, runs):
            blocks = self.blocks()
            while some := list(islice(blocks, _TOGETHER)):
                points_m, origin = _joined(some)
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
            points_m, origin = _joined(list(self.blocks(chosen)))
            near = np.argsort(first[origin])
            yield Samples(points_m[near], origin[near], None)


def _overlap(places: Array, runs: int) -> bool:
    """Whether boxes around so many runs of consecutive places (N, 3) overlap as those of an order in space do not."""
    whole = np.ptp(places, axis=0)
    thickness = 0.01 * float(whole.max())  # at least; a plane has none
    boxes = [np.prod(np.ptp(run, axis=0) + thickness) for run in np.array_split(places, runs)]
    return float(np.sum(boxes)) > 2 * float(np.prod(whole + thickness))


def _joined(some: list[Samples]) -> tuple[Array, IntArray]:
    """Points and origins of several blocks, which are left out of the list so that they are not there twice."""
    points_m = np.concatenate([block.points_m for block in some])
    origin = np.concatenate([block.origin for block in some])
    some.clear()
    return points_m, origin


def sample(surface: Surface, spacing_m: float, rng: np.random.Generator) -> Samples:
    """All samples of a surface at once. Raises as BlockedSamples."""
    blocks = list(BlockedSamples(surface, spacing_m, rng).blocks())
    normals = [block.normals for block in blocks if block.normals is not None]
    return Samples(
        np.concatenate([block.points_m for block in blocks]),
        np.concatenate([block.origin for block in blocks]),
        np.concatenate(normals) if normals else None,
    )


def _counts(surface: Surface, spacing_m: float, rng: np.random.Generator) -> IntArray:
    """(F,) number of samples on each face and those before it."""
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
    """(n, 3) points of a mesh, independent of one another and uniform in area."""
    share = np.cumsum(surface.face_areas_m2)
    chosen = np.searchsorted(share, rng.random(n) * share[-1], side="right")
    return random_places(surface, np.minimum(chosen, len(share) - 1), rng)


def normals_at(surface: Surface, origin: IntArray) -> Array | None:
    """Unit normals (K, 3) of samples of this origin (K,); None where the surface is a cloud without normals."""
    if surface.is_mesh:
        return surface.normals_of(origin)
    return None if surface.normals is None else surface.normals[origin]


def random_places(surface: Surface, faces: IntArray, rng: np.random.Generator) -> Array:
    """(K, 3) one random point on each of these faces (K,)."""
    return _places(surface, faces, rng.random((2, len(faces))))


def _places(surface: Surface, faces: IntArray, drawn: Array) -> Array:
    """(K, 3) the point on each of these faces (K,) that two numbers drawn from 0 to 1 (2, K) stand for."""
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
