"""Finds the control spheres where they really are, and says what each of them shows about the registration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from service.compute.markers.cones import Cone
from service.compute.markers.predicted import CLEARLY_VISIBLE, is_another, visible_cones
from service.compute.markers.records import SphereOutline
from service.compute.registration.accuracy import Evaluation, TriangulatedSphere, evaluate, locate_in_images
from service.compute.registration.identity import Assignment
from service.compute.scene import ControlSphere, PosedImages, ScanSpheres
from service.core.geometry import Array, inverse
from service.core.units import mm
from service.core.words import counted

LEAST_SHARE = 0.5  # of the outlines of one control sphere that should be seen
_NEAR_RADII = 1.0  # around a place that the images agree on, where the outlines that lack are searched
_FOUND_SHARE = 0.3  # of a capture's images: in a capture that shows no control sphere in so many, none was placed
_SIGMAS, _LEAST_DISPLACEMENT_M = 5.0, 0.3e-3  # from which a displacement is reported

#: Images, by index, and the cones that are expected in each, with the angle (rad) that each may be off.
ExpectedNearby = Sequence[tuple[int, Sequence[tuple[Cone, float]]]]
#: Searches images around expected cones, as `find_nearby` does, and gives the outlines in each.
SearchNearby = Callable[[ExpectedNearby], Sequence[Sequence[SphereOutline]]]


@dataclass(frozen=True, slots=True)
class ControlEvaluation:
    """The evaluation by control spheres: the paper's means, and each sphere by itself.

    Attributes:
        means: the mean errors over all outlines; None if no control sphere was measured.
        spheres: every control sphere that some image should show.
        outlines: outlines of each image, with those found by the search around the expected places.
        assignments: outline → control sphere of each image.
        located: the control spheres that at least two images locate, scan frame.
    """

    means: Evaluation | None
    spheres: tuple[ControlSphere, ...]
    outlines: tuple[tuple[SphereOutline, ...], ...] = field(repr=False)
    assignments: tuple[Assignment, ...] = field(repr=False)
    located: dict[int, TriangulatedSphere] = field(repr=False)

    @property
    def measured(self) -> int:
        """Number of control spheres that were measured."""
        return sum(s.measured > 0 for s in self.spheres)

    @property
    def worst_mm(self) -> float | None:
        """Largest radial error of a control sphere; None if none was measured."""
        return max((s.radial_error_mm for s in self.spheres if s.radial_error_mm is not None), default=None)

    @property
    def least_share(self) -> float:
        """Least share of measured among expected outlines of a control sphere."""
        return min((s.share for s in self.spheres), default=0.0)

    @property
    def findings(self) -> tuple[str, ...]:
        """The texts of what is wrong with control spheres."""
        return tuple(s.finding for s in self.spheres if s.finding)

    def measures(self) -> dict[str, float]:
        """Return the figures that gates judge, by their names in a run."""
        out = {
            "control_spheres": float(self.measured),
            "control_spheres_expected": float(len(self.spheres)),
            "control_outlines_share": self.least_share,
        }
        if self.worst_mm is not None:
            out["worst_control_sphere_mm"] = self.worst_mm
        return out


def evaluate_controls(
    outlines: Sequence[Sequence[SphereOutline]],
    taken: Sequence[Assignment],
    images: PosedImages,
    spheres: ScanSpheres,
    *,
    captures: Sequence[int] | None = None,
    search: SearchNearby | None = None,
) -> ControlEvaluation:
    """Find the control spheres in registered images and evaluate the registration by them.

    Args:
        outlines: the registration's outlines of each image.
        taken: the outlines of each image that are registration spheres.
        images: the images with T_scan_camera, metric; NaN for images without a pose, which count as if they were not
            there.
        spheres: registration and control spheres, scan frame.
        captures: (N,) capture of each image; of a capture in which control spheres are not seen, none is expected.
            None: all one.
        search: searches images for the outlines that are missing; None: only `outlines` count.
    """
    posed = np.flatnonzero(np.isfinite(images.poses).all(axis=(1, 2)))
    capture = np.zeros(len(images.poses), dtype=np.int64) if captures is None else np.asarray(captures)
    every = np.vstack([spheres.centres_m, spheres.control_m])
    first = len(spheres.centres_m)
    cones = {int(i): visible_cones(inverse(images.poses[i]), every, spheres.radius_m, images.camera) for i in posed}
    clear = {
        i: visible_cones(inverse(images.poses[i]), every, spheres.radius_m, images.camera, least=CLEARLY_VISIBLE)
        for i in cones
    }
    expected = {s: [i for i, shown in clear.items() if first + s in shown] for s in range(len(spheres.control_m))}
    scene = SeenSpheres([list(found) for found in outlines], [set(a.markers) for a in taken], images, spheres)
    places = scene.places(expected)
    shown = _captures_shown(places, capture, expected)
    expected = {s: [i for i in mine if int(capture[i]) in shown] for s, mine in expected.items()}
    if search is not None:
        wanted = _lacking(places, expected, cones, images, spheres)
        if wanted:
            for (i, _), found in zip(wanted, search(wanted), strict=True):
                scene.add(i, found)
            places = scene.places(expected)
    assignments = [Assignment(T_camera_scan=inverse(T) if np.isfinite(T).all() else None) for T in images.poses]
    for s, place in places.items():
        for i, j in place.outlines.items():
            if int(capture[i]) in shown:
                assignments[i].markers[j] = s
    return _evaluated(scene, assignments, images, spheres, expected)


def _evaluated(
    scene: SeenSpheres,
    assignments: Sequence[Assignment],
    images: PosedImages,
    spheres: ScanSpheres,
    expected: dict[int, list[int]],
) -> ControlEvaluation:
    located = locate_in_images(
        scene.outlines, assignments, images.poses, spheres.control_m, spheres.radius_m, least_images=2
    )
    means = None
    if any(a.markers for a in assignments):
        controls = ScanSpheres(spheres.control_m, spheres.radius_m)
        means = evaluate(scene.outlines, assignments, images, controls)
    figures = {} if means is None else means.per_sphere()
    off = {s: found.centre_m - spheres.control_m[s] for s, found in located.items()}
    rows: list[ControlSphere] = []
    for s, mine in expected.items():
        radial, px, n = figures.get(s, (None, None, 0))
        if not mine and not n:
            continue
        sigma_m = float(np.sqrt(np.trace(located[s].covariance_m2))) if s in located else None
        rows.append(
            ControlSphere(
                s,
                max(len(mine), n),
                n,
                radial,
                px,
                mm(float(np.linalg.norm(off[s]))) if s in off else None,
                None if sigma_m is None else mm(sigma_m),
            )
        )
    told = tuple(_with_finding(row, off) for row in rows)
    return ControlEvaluation(means, told, tuple(map(tuple, scene.outlines)), tuple(assignments), located)


def _with_finding(row: ControlSphere, off: dict[int, Array]) -> ControlSphere:
    """Return the row with its finding."""
    finding, name = "", f"control sphere {row.index}"
    if not row.measured:
        finding = (
            f"{name} was found in none of the {counted(row.expected, 'image')} that should show it, within "
            f"{mm(WINDOW_M):.0f} mm of its place: it was taken away or hidden, it is not where the list has it, or "
            "the registration is wrong by more than that"
        )
    elif row.share < LEAST_SHARE:
        finding = (
            f"{name} was measured in {row.measured} of {counted(row.expected, 'image')} that should show it: uncover "
            "it, or place it where more images see it"
        )
    displaced = row.displacement_mm is not None and row.displacement_mm > max(
        mm(_LEAST_DISPLACEMENT_M), _SIGMAS * (row.displacement_sigma_mm or 0.0)
    )
    if displaced and row.displacement_mm is not None:
        mine = off[row.index]
        others = [v for s, v in off.items() if s != row.index]
        alike = bool(others) and all(float(np.linalg.norm(v - mine)) < 0.5 * np.linalg.norm(mine) for v in others)
        why = (
            "as all others are, in the same direction: the registration itself is off, or the control scan is"
            if alike
            else "it was moved between the scan and the images, or its place in the list is wrong"
        )
        finding = "; ".join(
            filter(
                None,
                [finding, f"{name} is {row.displacement_mm:.2f} mm from where scan and registration put it: {why}"],
            )
        )
    return replace(row, finding=finding)


def _captures_shown(
    places: dict[int, SeenPlace], capture: NDArray[np.int64], expected: dict[int, list[int]]
) -> set[int]:
    """Return the captures in which control spheres were placed: those that show one, or all if none does."""
    out: set[int] = set()
    for c in set(capture.tolist()):
        for s, place in places.items():
            mine = [i for i in expected[s] if int(capture[i]) == c]
            seen = sum(int(capture[i]) == c for i in place.outlines)
            if seen and seen >= _FOUND_SHARE * len(mine):
                out.add(int(c))
    return out or {int(c) for c in capture.tolist()}


def _lacking(
    places: dict[int, SeenPlace],
    expected: dict[int, list[int]],
    cones: dict[int, dict[int, Cone]],
    images: PosedImages,
    spheres: ScanSpheres,
) -> list[tuple[int, list[tuple[Cone, float]]]]:
    """Return where to search for the missing outlines, by image: near a place that is known, else wide."""
    first = len(spheres.centres_m)
    wanted: dict[int, list[tuple[Cone, float]]] = {}
    for s, mine in expected.items():
        place = places.get(s)
        for i in mine:
            if place is not None and i in place.outlines:
                continue
            cone, window_m = cones[i][first + s], WINDOW_M
            distance_m = spheres.radius_m / np.sin(cone.half_angle_rad)
            if place is not None and len(place.outlines) > 0.3 * len(mine):
                there = visible_cones(inverse(images.poses[i]), place.centre_m[None], spheres.radius_m, images.camera)
                if not there:
                    continue
                cone, window_m = there[0], _NEAR_RADII * spheres.radius_m
            wanted.setdefault(i, []).append((cone, float(window_m / distance_m)))
    return sorted(wanted.items())


_SAME_PLACE, _SAME_SIZE = 0.25, 0.07  # in radii, and relative: an outline of the sphere at a place
_MOST_PAIRS = 3000  # of outlines that are intersected for the place of spheres
_MOST_PLACES = 12
_UNSUPPORTED_M = 0.05  # a place that hardly any image supports counts as if it were further away by so much
WINDOW_M = 0.05  # from its expected place: a sphere that is further away counts as missing


@dataclass(frozen=True, slots=True)
class SeenPlace:
    """The place at which images see a sphere, scan frame, and image → outline of those that do."""

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
        """Return whether rays (K,) show a sphere at places (P, 3), as (P, K), and their distance from it in radii."""
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
        """Return the place of each control sphere that images show, by its index."""
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
        """Return the free outlines that may be control spheres: near one of them, of its size."""
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
        """Return (P, K, 3) the point of each ray nearest to each of (P, 3) points."""
        along = np.einsum("pki,ki->pk", points[:, None, :] - rays.origin[None], rays.direction)
        return rays.origin[None] + along[..., None] * rays.direction[None]

    def _best(self, rays: _Rays, left: NDArray[np.bool_]) -> SeenPlace | None:
        """Return the place that most images see, by the outlines left; of equal ones, where they agree best."""
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
        outlines = self._images_showing(mine, best[1])
        if not outlines:
            return None
        # The place from all its outlines, and the outlines of that place.
        found = self._intersected(outlines, best[1])
        return SeenPlace(found, self._images_showing(mine, found) or outlines)

    def _single(self, rays: _Rays) -> Array:
        """Return places by single outlines, each where it comes nearest to a control sphere, for few images."""
        if len(set(rays.image.tolist())) > 2:
            return np.zeros((0, 3))
        return self._nearest(rays, self._spheres.control_m).reshape(-1, 3)

    def _images_showing(self, rays: _Rays, place: Array) -> dict[int, int]:
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
    """Return (P, 3) where pairs of rays of two images pass each other closely."""
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
