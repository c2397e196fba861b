"""Where images see spheres that a registration did not use: the places on which most of their outlines agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from service.compute.evaluation.closure import locate_in_images
from service.compute.markers.records import SphereOutline
from service.compute.markers.search.nearby import is_another
from service.compute.registration.identification.identity import Assignment
from service.compute.scene import PosedImages, ScanSpheres
from service.core.geometry import Array

_SAME_PLACE, _SAME_SIZE = 0.25, 0.07  # in radii, and relative: an outline of the sphere at a place
_MOST_PAIRS = 3000  # of outlines that are intersected for the place of spheres
_MOST_PLACES = 12
_UNSUPPORTED_M = 0.05  # a place that hardly any image supports counts as if it were further away by so much
WINDOW_M = 0.05  # from its expected place: a sphere that is further away counts as missing


@dataclass(frozen=True, slots=True)
class SeenPlace:
    """Where images see a sphere, scan frame, and image → outline of those that do."""

    centre_m: Array
    outlines: dict[int, int]


@dataclass(frozen=True, slots=True)
class _Rays:
    """K outlines as rays, scan frame."""

    image: NDArray[np.int64]
    outline: NDArray[np.int64]
    origin: Array  # (K, 3)
    direction: Array  # (K, 3)
    half: Array  # (K,)

    def meeting(self, places: Array, radius_m: float) -> tuple[NDArray[np.bool_], Array]:
        """Whether rays (K,) show a sphere at places (P, 3), as (P, K), and their distance from it in radii."""
        to = places[:, None, :] - self.origin[None]
        distance = np.maximum(np.linalg.norm(to, axis=2), 2 * radius_m)
        half = np.arcsin(radius_m / distance)
        cosine = np.einsum("pki,ki->pk", to, self.direction) / distance
        off = np.arccos(np.clip(cosine, -1, 1)) / half
        return (off < _SAME_PLACE) & (np.abs(self.half / half - 1) < _SAME_SIZE), off


class SeenSpheres:
    """The outlines of all images, and those of them that are no registration spheres."""

    def __init__(
        self,
        outlines: list[list[SphereOutline]],
        taken: Sequence[set[int]],
        images: PosedImages,
        spheres: ScanSpheres,
    ) -> None:
        self.outlines, self._taken, self._images, self._spheres = outlines, taken, images, spheres

    def add(self, image: int, found: Sequence[SphereOutline]) -> None:
        """Add outlines of an image that are not those of spheres that it already has."""
        for outline in found:
            if is_another(outline, self.outlines[image]):
                self.outlines[image].append(outline)

    def places(self, expected: dict[int, list[int]]) -> dict[int, SeenPlace]:
        """The place of each control sphere that images show, by its index."""
        rays = self._rays()
        seen: list[SeenPlace] = []
        left = np.ones(len(rays.image), dtype=bool)
        images = len(set(rays.image.tolist()))
        while len(seen) < _MOST_PLACES and left.any():
            best = self._best(rays, left)
            if best is None or len(best.outlines) < min(2, images):
                break
            seen.append(best)
            left &= ~np.array([best.outlines.get(int(i)) == j for i, j in zip(rays.image, rays.outline, strict=True)])
        if not seen:
            return {}
        support = np.array([len(place.outlines) for place in seen])
        cost = np.full((len(expected), len(seen)), 1.0)
        for s, mine in expected.items():
            apart = np.linalg.norm([place.centre_m - self._spheres.control_m[s] for place in seen], axis=1)
            lacking = 1 - np.minimum(1.0, support / max(1, len(mine)))
            cost[s] = np.where(apart <= WINDOW_M, apart + _UNSUPPORTED_M * lacking, 1.0)
        rows, columns = linear_sum_assignment(cost)
        return {int(s): seen[k] for s, k in zip(rows, columns, strict=True) if cost[s, k] < 1.0}

    def _rays(self) -> _Rays:
        """The free outlines that may be control spheres: near one of them, of its size."""
        image: list[int] = []
        outline: list[int] = []
        for i, found in enumerate(self.outlines):
            if np.isfinite(self._images.poses[i]).all():
                free = [j for j in range(len(found)) if j not in self._taken[i]]
                image += [i] * len(free)
                outline += free
        index = np.array(image, dtype=np.int64)
        cones = [self.outlines[i][j].cone for i, j in zip(image, outline, strict=True)]
        T = self._images.poses[index]
        axes = np.array([c.axis for c in cones], dtype=np.float64).reshape(-1, 3)
        half = np.array([c.half_angle_rad for c in cones], dtype=np.float64)
        rays = _Rays(
            index, np.array(outline, dtype=np.int64), T[:, :3, 3], np.einsum("kij,kj->ki", T[:, :3, :3], axes), half
        )
        nearest = self._nearest(rays, self._spheres.control_m)
        gap = np.linalg.norm(nearest - self._spheres.control_m[:, None], axis=2)
        distance = np.linalg.norm(nearest - rays.origin[None], axis=2)
        size = np.arcsin(np.minimum(self._spheres.radius_m / np.maximum(distance, 1e-9), 0.9)) / np.maximum(
            half, 1e-9
        )
        # The sphere may be nearer or farther by as much as it may be aside.
        fits = (gap < WINDOW_M) & (np.abs(size - 1) < _SAME_SIZE + WINDOW_M / np.maximum(distance, WINDOW_M))
        near = np.flatnonzero(fits.any(axis=0)) if len(fits) else np.zeros(0, dtype=np.int64)
        return _Rays(rays.image[near], rays.outline[near], rays.origin[near], rays.direction[near], rays.half[near])

    @staticmethod
    def _nearest(rays: _Rays, points: Array) -> Array:
        """(P, K, 3) the point of each ray nearest to each of (P, 3) points."""
        along = np.einsum("pki,ki->pk", points[:, None, :] - rays.origin[None], rays.direction)
        return rays.origin[None] + along[..., None] * rays.direction[None]

    def _best(self, rays: _Rays, left: NDArray[np.bool_]) -> SeenPlace | None:
        """The place that most images see, by the outlines left; of equal ones, where they agree best."""
        which = np.flatnonzero(left)
        mine = _Rays(
            rays.image[which], rays.outline[which], rays.origin[which], rays.direction[which], rays.half[which]
        )
        candidates = np.vstack([_crossings(mine, self._spheres.radius_m), self._single(mine)])
        if not len(candidates):
            return None
        best: tuple[float, Array] | None = None
        for start in range(0, len(candidates), 500):
            part = candidates[start : start + 500]
            meet, off = mine.meeting(part, self._spheres.radius_m)
            score = np.zeros(len(part))
            for i in np.unique(mine.image):
                column = mine.image == i
                nearest = np.where(meet[:, column], off[:, column], np.inf).min(axis=1)
                score += np.where(np.isfinite(nearest), 1 - nearest, 0.0)
            k = int(np.argmax(score))
            if best is None or score[k] > best[0]:
                best = float(score[k]), part[k]
        assert best is not None
        outlines = self._shown(mine, best[1])
        if not outlines:
            return None
        # The place from all its outlines, and the outlines of that place.
        found = self._intersected(outlines, best[1])
        return SeenPlace(found, self._shown(mine, found) or outlines)

    def _single(self, rays: _Rays) -> Array:
        """Places by single outlines, each where it comes nearest to a control sphere, for a capture of few images."""
        if len(set(rays.image.tolist())) > 2:
            return np.zeros((0, 3))
        return self._nearest(rays, self._spheres.control_m).reshape(-1, 3)

    def _shown(self, rays: _Rays, place: Array) -> dict[int, int]:
        meet, off = rays.meeting(place[None], self._spheres.radius_m)
        out: dict[int, int] = {}
        for k in np.argsort(off[0]):
            if meet[0, k]:
                out.setdefault(int(rays.image[k]), int(rays.outline[k]))
        return out

    def _intersected(self, outlines: dict[int, int], start: Array) -> Array:
        assignments = [Assignment({outlines[i]: 0} if i in outlines else {}) for i in range(len(self.outlines))]
        found = locate_in_images(
            self.outlines, assignments, self._images.poses, start[None], self._spheres.radius_m, least_images=2
        )
        return found[0].centre_m if found else start


def _crossings(rays: _Rays, radius_m: float) -> Array:
    """(P, 3) where pairs of rays of two images pass each other closely."""
    a, b = np.triu_indices(len(rays.image), 1)
    other = rays.image[a] != rays.image[b]
    a, b = a[other], b[other]
    if len(a) > _MOST_PAIRS:
        chosen = np.random.default_rng(0).choice(len(a), _MOST_PAIRS, replace=False)
        a, b = a[chosen], b[chosen]
    u, v, w = rays.direction[a], rays.direction[b], rays.origin[b] - rays.origin[a]
    c = np.einsum("ni,ni->n", u, v)
    det = 1 - c**2
    wide = det > 1e-4
    a, u, v, w, c, det = a[wide], u[wide], v[wide], w[wide], c[wide], det[wide]
    b = b[wide]
    wu, wv = np.einsum("ni,ni->n", w, u), np.einsum("ni,ni->n", w, v)
    s, t = (wu - c * wv) / det, (c * wu - wv) / det
    near_a, near_b = rays.origin[a] + s[:, None] * u, rays.origin[b] + t[:, None] * v
    close = (np.linalg.norm(near_a - near_b, axis=1) < 0.5 * radius_m) & (s > 0) & (t > 0)
    return 0.5 * (near_a + near_b)[close]
