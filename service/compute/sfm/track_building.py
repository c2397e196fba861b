"""Builds tracks of matched features and triangulates them from known camera poses, in NumPy alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from service.compute.descent import gauss_newton
from service.core.geometry import Array

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
