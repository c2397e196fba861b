"""Features and verified matches of images: found, packed, joined into tracks, and triangulated."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from service.compute.descent import gauss_newton
from service.core.errors import DataError
from service.core.geometry import Array

_NORM = 512.0  # length of a descriptor in unsigned bytes
_ROWS = 512  # descriptors compared at a time, so that the products stay in the processor's cache
_MOST_ANGLE_RAD = 0.7  # between descriptors of one scene point
_MOST_RATIO = 0.8  # angle to the nearest descriptor over that to the second nearest (Lowe, 2004, 7.1)


# What NumPy and the archive format raise for invalid bytes.
_DAMAGED = (ValueError, KeyError, TypeError, IndexError, OSError, EOFError, RuntimeError, zipfile.BadZipFile,
            zlib.error)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class ImageFeatures:
    """SIFT features of one image (colmap.py says which, if there are too many).

    Attributes:
        width, height: size of the image as captured, px.
        pixels: (n, 2) float32 in the image as captured, first pixel's centre at 0.
        scales_px: (n,) float32 in the image as captured.
        descriptors: (n, 128) uint8.
    """

    width: int
    height: int
    pixels: NDArray[np.float32] = field(repr=False)
    scales_px: NDArray[np.float32] = field(repr=False)
    descriptors: NDArray[np.uint8] = field(repr=False)

    def to_bytes(self) -> bytes:
        """Return a NumPy archive (.npz, about 0.1 kB a feature); the same features give the same bytes."""
        buffer = io.BytesIO()
        np.savez_compressed(
            buffer,
            size=np.array([self.width, self.height]),
            pixels=self.pixels,
            scales_px=self.scales_px,
            descriptors=self.descriptors,
        )
        return buffer.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes) -> ImageFeatures:
        """Rebuild the features from `to_bytes`'s archive.

        Raises:
            DataError: the bytes are not such an archive.
        """
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as archive:
                width, height = (int(v) for v in archive["size"])
                return cls(width, height, archive["pixels"], archive["scales_px"], archive["descriptors"])
        except _DAMAGED as error:
            raise DataError("these bytes are not features of an image", remedy="Extract them again") from error


@dataclass(frozen=True, slots=True, eq=False)
class PairMatches:
    """Matches of two images that agree with one epipolar geometry; empty if the images have nothing in common.

    Attributes:
        first, second: names of the images, first < second.
        features: (m, 2) uint32 feature indices in the first and the second image.
        configuration: COLMAP's kind of two-view geometry.
        matrices: (3, 3, 3) essential, fundamental and homography matrix from the first to the second image; zero if
            absent.
    """

    first: str
    second: str
    features: NDArray[np.uint32] = field(repr=False)
    configuration: int
    matrices: Array = field(repr=False)

    @property
    def pair(self) -> tuple[str, str]:
        """Names of both images in order."""
        return self.first, self.second


def pack_matches(matches: Sequence[PairMatches]) -> bytes:
    """Pack matches of any number of pairs into a NumPy archive (.npz), sorted by pair, whatever the given order."""
    ordered = sorted(matches, key=lambda m: m.pair)
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        pairs=np.array(json.dumps([m.pair for m in ordered])),
        counts=np.array([len(m.features) for m in ordered], dtype=np.int64),
        features=np.concatenate([np.empty((0, 2), np.uint32), *(m.features for m in ordered)]),
        configurations=np.array([m.configuration for m in ordered], dtype=np.int64),
        matrices=np.array([m.matrices for m in ordered]).reshape(-1, 3, 3, 3),
    )
    return buffer.getvalue()


def unpack_matches(data: bytes) -> list[PairMatches]:
    """Rebuild the matches from `pack_matches`'s archive, sorted by pair.

    Raises:
        DataError: the bytes are not such an archive.
    """
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            pairs = json.loads(str(archive["pairs"]))
            ends = np.cumsum(archive["counts"])
            each = np.split(archive["features"], ends[:-1])
            kinds, matrices = archive["configurations"], archive["matrices"]
            return [
                PairMatches(first, second, each[k], int(kinds[k]), matrices[k])
                for k, (first, second) in enumerate(pairs)
            ]
    except _DAMAGED as error:
        raise DataError("these bytes are not matches of images", remedy="Match the images again") from error


def match_descriptors(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Return indices (m, 2) of descriptors (n, 128) and (k, 128) that are mutual nearest and pass the ratio test.

    Products of unsigned bytes are integers below 2^24, which single precision adds exactly in any order: the same
    descriptors give the same matches on every machine.
    """
    if len(first) < 2 or len(second) < 2:
        return np.empty((0, 2), dtype=np.uint32)
    a, b = first.astype(np.float32), second.astype(np.float32)
    forth, clear = _nearest(a, b)
    rows = np.flatnonzero(clear)
    wanted = np.unique(forth[rows])
    back = np.full(len(b), -1, dtype=np.int64)
    nearest, clear = _nearest(b[wanted], a)
    back[wanted[clear]] = nearest[clear]
    rows = rows[back[forth[rows]] == rows]
    return np.column_stack([rows, forth[rows]]).astype(np.uint32)


def _nearest(a: NDArray[np.float32], b: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Find the nearest descriptor of b for each of a, and whether it passes the limits on distance and ratio."""
    index = np.empty(len(a), dtype=np.int64)
    clear = np.empty(len(a), dtype=np.bool_)
    turned = np.ascontiguousarray(b.T)
    buffer = np.empty((_ROWS, len(b)), dtype=np.float32)
    for start in range(0, len(a), _ROWS):
        part = a[start : start + _ROWS]
        products = np.matmul(part, turned, out=buffer[: len(part)])
        rows = np.arange(len(part))
        best = products.argmax(axis=1)
        cosine = products[rows, best].astype(np.float64) / _NORM**2
        products[rows, best] = -1.0
        second = products.max(axis=1).astype(np.float64) / _NORM**2
        angle = np.arccos(np.minimum(cosine, 1.0))
        index[start : start + len(part)] = best
        clear[start : start + len(part)] = (angle <= _MOST_ANGLE_RAD) & (
            angle < _MOST_RATIO * np.arccos(np.minimum(second, 1.0))
        )
    return index, clear


@dataclass(frozen=True, slots=True)
class Tracks:
    """Observations of scene points.

    Attributes:
        image: (O,) index of the image, in the order of the model's poses.
        point: (O,) index of the point.
        pixels: (O, 2) places in the image as captured.
        points: (P, 3) positions in the model's frame and unit; every point has at least two observations.
    """

    image: NDArray[np.int64] = field(repr=False)
    point: NDArray[np.int64] = field(repr=False)
    pixels: Array = field(repr=False)
    points: Array = field(repr=False)

    def thinned(self, most: int) -> Tracks:
        """Reduce to about `most` observations, keeping the longest tracks; unchanged if there are few enough.

        Tracks are taken in the order of their length, after each image has got its share.
        """
        if len(self.image) <= most:
            return self
        length = np.bincount(self.point, minlength=len(self.points))
        n_images = int(self.image.max()) + 1
        keep = np.zeros(len(self.points), dtype=bool)
        share = max(1, most // n_images // 2)
        order = np.argsort(-length[self.point], kind="stable")
        for i in range(n_images):  # so that a weakly connected image keeps its few points
            mine = order[self.image[order] == i][:share]
            keep[self.point[mine]] = True
        for p in np.argsort(-length, kind="stable"):
            if length[keep].sum() >= most:
                break
            keep[p] = True
        number = np.cumsum(keep) - 1
        rows = keep[self.point]
        return Tracks(self.image[rows], number[self.point[rows]], self.pixels[rows], self.points[keep])


Index = NDArray[np.int64]
_LEAST_ANGLE_RAD = np.radians(1.5)  # between the rays to a point; below it, the depth is meaningless
_ROUNDS = 6  # of reweighting in a triangulation


@dataclass(frozen=True, slots=True)
class TrackedFeatures:
    """Assignment of features of images to tracks.

    Attributes:
        image: (O,) index of the image.
        feature: (O,) index of the feature in the image.
        track: (O,) index of the track, 0 … count - 1; every track is seen in at least two images, once in each.
        count: number of tracks.
    """

    image: Index = field(repr=False)
    feature: Index = field(repr=False)
    track: Index = field(repr=False)
    count: int

    def kept(self, observations: NDArray[np.bool_], least: int = 2) -> tuple[TrackedFeatures, Index]:
        """Select observations of tracks that still have `least` of them or more; return these tracks' numbers too."""
        length = np.bincount(self.track[observations], minlength=self.count)
        tracks = np.flatnonzero(length >= least)
        number = np.full(self.count, -1, dtype=np.int64)
        number[tracks] = np.arange(len(tracks))
        rows = observations & (number[self.track] >= 0)
        return TrackedFeatures(self.image[rows], self.feature[rows], number[self.track[rows]], len(tracks)), tracks


def build_tracks(
    counts: Sequence[int], pairs: Sequence[tuple[int, int]], matches: Sequence[NDArray[np.uint32]]
) -> TrackedFeatures:
    """Join features by matches, directly or indirectly. An image that a track meets twice is removed from it.

    Args:
        counts: number of features of each image.
        pairs: indices of the images of each pair.
        matches: (m, 2) features of each pair.
    """
    offset = np.concatenate([[0], np.cumsum(np.asarray(counts, dtype=np.int64))])
    ends = [np.empty((0, 2), dtype=np.int64)]
    ends += [m.astype(np.int64) + offset[list(pair)] for pair, m in zip(pairs, matches, strict=True)]
    edges = np.concatenate(ends)
    n = int(offset[-1])
    graph = coo_matrix((np.ones(len(edges), dtype=np.int8), (edges[:, 0], edges[:, 1])), shape=(n, n))
    label = np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)
    node = np.unique(edges)
    image = np.searchsorted(offset, node, side="right") - 1
    key = label[node] * len(counts) + image
    _, where, often = np.unique(key, return_inverse=True, return_counts=True)
    once = often[where] == 1
    order = np.argsort(label[node], kind="stable")
    _, track = np.unique(label[node], return_inverse=True)
    every = TrackedFeatures(image[order], (node - offset[image])[order], track[order], int(track.max(initial=-1)) + 1)
    return every.kept(once[order])[0]


def thinned(sightings: TrackedFeatures, pixels: Array, share: int, pair_share: int, size: tuple[int, int]) -> Index:
    """Select the tracks that a mapper needs: the longest ones of each image and pair, spread over the images.

    Args:
        sightings: all tracks.
        pixels: (O, 2) places of the observations.
        share: number of tracks per image, spread over a grid of cells.
        pair_share: number of tracks per pair of images, if it has as many.
        size: width and height of the images, px.
    """
    length = np.bincount(sightings.track, minlength=sightings.count)
    rank = np.empty(sightings.count, dtype=np.int64)
    rank[np.argsort(-length, kind="stable")] = np.arange(sightings.count)
    keep = np.zeros(sightings.count, dtype=np.bool_)
    cells = np.clip((pixels / np.array(size) * np.array([8, 6])).astype(np.int64), 0, [7, 5])
    cell = cells[:, 0] * 6 + cells[:, 1]
    order = np.argsort(rank[sightings.track], kind="stable")
    n_images = int(sightings.image.max(initial=-1)) + 1
    for i in range(n_images):
        mine = order[sightings.image[order] == i]
        by_cell = mine[np.argsort(cell[mine], kind="stable")]  # in each cell the longest tracks first
        _, first = np.unique(cell[by_cell], return_index=True)
        place = np.arange(len(by_cell)) - np.repeat(first, np.diff([*first, len(by_cell)]))
        chosen = by_cell[np.argsort(place, kind="stable")][:share]  # taken from each cell in turn
        keep[sightings.track[chosen]] = True
    return np.flatnonzero(keep | _of_pairs(sightings, rank, keep, pair_share, n_images))


def _of_pairs(
    sightings: TrackedFeatures, rank: Index, keep: NDArray[np.bool_], share: int, n_images: int
) -> NDArray[np.bool_]:
    """Select tracks that pairs of images need beyond those already selected, so that no weak connection is lost."""
    seen = np.zeros((n_images, sightings.count), dtype=np.bool_)
    seen[sightings.image, sightings.track] = True
    order = np.argsort(rank, kind="stable")
    seen, kept = seen[:, order], keep[order]
    added = np.zeros_like(kept)
    for i in range(n_images):
        mine = np.flatnonzero(seen[i])
        common = seen[i + 1 :, mine]
        have = (common & (kept | added)[mine]).sum(axis=1)
        for j in np.flatnonzero((have < share) & (common.sum(axis=1) > have)):
            rest = mine[common[j] & ~(kept | added)[mine]]
            added[rest[: share - have[j]]] = True
    out = np.zeros_like(keep)
    out[order] = added
    return out


def triangulate(poses: Array, plane: Array, sightings: TrackedFeatures, sigma: float) -> tuple[Array, Array]:
    """Triangulate scene points (P, 3) robustly from known poses; return the error of each observation too.

    First the point nearest to all rays, then Gauss–Newton steps on the reprojection errors; both use Cauchy weights,
    which favour the position on which most observations of a track agree.

    Args:
        poses: (N, 4, 4) T_world_camera.
        plane: (O, 2) undistorted normalised coordinates of the observations.
        sightings: tracks.
        sigma: scale of the weights, normalised coordinates.

    Returns:
        Points (P, 3), and errors (O,) in normalised coordinates, infinite behind a camera.
    """
    R, centre = poses[sightings.image, :3, :3], poses[sightings.image, :3, 3]
    ray = np.einsum("oij,oj->oi", R, np.column_stack([plane, np.ones(len(plane))]))
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    weight = np.ones(len(plane))
    points = np.zeros((sightings.count, 3))
    for _ in range(_ROUNDS // 2):
        A = weight[:, None, None] * across
        points = _solved(_summed(A, sightings), _summed(np.einsum("oij,oj->oi", A, centre), sightings))
        error = reprojection(poses, points, plane, sightings)[0]
        weight = 1 / (1 + np.minimum(error / sigma, 1e6) ** 2)

    def step_at(points: Array) -> Array:
        error, residual, J = reprojection(poses, points, plane, sightings)
        weight = 1 / (1 + np.minimum(error / sigma, 1e6) ** 2)
        JW = weight[:, None, None] * J
        return _solved(
            _summed(np.einsum("oki,okj->oij", JW, J), sightings),
            _summed(np.einsum("oki,ok->oi", JW, residual), sightings),
        )

    points = gauss_newton(points, step_at, lambda at, step: at - step, most=_ROUNDS // 2, settled=0.0)
    return points, reprojection(poses, points, plane, sightings)[0]


def reprojection(poses: Array, points: Array, plane: Array, sightings: TrackedFeatures) -> tuple[Array, Array, Array]:
    """Return reprojection errors' length (O,) and components (O, 2), and derivatives (O, 2, 3) by the points."""
    R = poses[sightings.image, :3, :3]
    c = np.einsum("oji,oj->oi", R, points[sightings.track] - poses[sightings.image, :3, 3])
    front = c[:, 2] > 1e-9
    depth = np.where(front, c[:, 2], 1.0)
    residual = c[:, :2] / depth[:, None] - plane
    d = np.zeros((len(c), 2, 3))
    d[:, 0, 0] = d[:, 1, 1] = 1 / depth
    d[:, :, 2] = -c[:, :2] / depth[:, None] ** 2
    error = np.where(front, np.linalg.norm(residual, axis=1), np.inf)
    residual = np.where(front[:, None], residual, 0.0)
    return error, residual, np.where(front[:, None, None], d @ np.swapaxes(R, 1, 2), 0.0)


def wide_enough(poses: Array, points: Array, sightings: TrackedFeatures) -> NDArray[np.bool_]:
    """Return (P,) whether the angle between the rays to a point is large enough."""
    ray = points[sightings.track] - poses[sightings.image, :3, 3]
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    mean = _summed(ray, sightings)
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-12)[:, None]
    off = np.arccos(np.clip(np.einsum("oi,oi->o", ray, mean[sightings.track]), -1, 1))
    widest = np.zeros(sightings.count)
    np.maximum.at(widest, sightings.track, off)
    return np.asarray(widest >= _LEAST_ANGLE_RAD / 2)


def _summed(values: Array, sightings: TrackedFeatures) -> Array:
    """Return the sums of (O, …) over the observations of each track."""
    flat = values.reshape(len(values), -1)
    sums = [np.bincount(sightings.track, flat[:, k], minlength=sightings.count) for k in range(flat.shape[1])]
    return np.array(sums, dtype=np.float64).T.reshape(sightings.count, *values.shape[1:])


def _solved(A: Array, b: Array) -> Array:
    """Return the solutions x (P, 3) of A x = b with slight damping, so that a point without parallax stays finite."""
    trace = np.trace(A, axis1=1, axis2=2)
    damped: Array = A + (1e-9 * trace + 1e-300)[:, None, None] * np.eye(3)
    return np.asarray(np.linalg.solve(damped, b[:, :, None])[:, :, 0], dtype=np.float64)
