"""Finds the control spheres where they really are, and says what each of them shows about the registration.

A control sphere takes no part in choosing outlines. Its place is where the images see it, within centimetres of where
the registration expects it, so that a displaced sphere counts with its displacement and a missing one as missing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from service.compute.evaluation.accuracy import Evaluation, evaluate
from service.compute.evaluation.closure import TriangulatedSphere, locate_in_images
from service.compute.evaluation.seen_places import WINDOW_M, SeenPlace, SeenSpheres
from service.compute.markers.cones import Cone
from service.compute.markers.records import SphereOutline
from service.compute.markers.search.predicted import CLEARLY_VISIBLE, visible_cones
from service.compute.registration.identification.identity import Assignment
from service.compute.scene import PosedImages, ScanSpheres
from service.core.geometry import Array, inverse
from service.core.text.counts import counted
from service.core.units import mm

MOST_WORST_MM = 0.5  # radial error of one control sphere, where the paper's mean over all is 0.35
LEAST_SHARE = 0.5  # of the outlines of one control sphere that should be seen
_NEAR_RADII = 1.0  # around a place that the images agree on, where the outlines that lack are searched
_FOUND_SHARE = 0.3  # of a capture's images: in a capture that shows no control sphere in so many, none was placed
_SIGMAS, _LEAST_DISPLACEMENT_M = 5.0, 0.3e-3  # from which a displacement is told

#: Images, by index, and the cones that are expected in each, with the angle (rad) that each may be off.
ExpectedNearby = Sequence[tuple[int, Sequence[tuple[Cone, float]]]]
#: Searches images around expected cones, as `find_nearby` does, and gives the outlines in each.
SearchNearby = Callable[[ExpectedNearby], Sequence[Sequence[SphereOutline]]]


@dataclass(frozen=True, slots=True)
class ControlSphere:
    """What one control sphere shows.

    Attributes:
        index: in the list of control spheres.
        expected: number of images that should show it.
        measured: number of images in which it was measured.
        radial_error_mm: mean over its outlines; None if it was not measured.
        reprojection_error_px: mean over its outlines.
        displacement_mm: from where scan and registration put it to where the images see it; None below three images.
        displacement_sigma_mm: of the displacement, as far as the outlines determine it.
        finding: what is wrong, and what to do; "" if nothing is.
    """

    index: int
    expected: int
    measured: int
    radial_error_mm: float | None = None
    reprojection_error_px: float | None = None
    displacement_mm: float | None = None
    displacement_sigma_mm: float | None = None
    finding: str = ""

    @property
    def share(self) -> float:
        """Share of the expected outlines that were measured, 1 if none was expected."""
        return min(1.0, self.measured / self.expected) if self.expected else 1.0


@dataclass(frozen=True, slots=True)
class ControlEvaluation:
    """The evaluation by control spheres: the paper's means, and each sphere by itself.

    Attributes:
        means: over all outlines; None if no control sphere was measured.
        spheres: every control sphere that some image should show.
        outlines: of each image, with those found by the search around the expected places.
        assignments: of each image, outline → control sphere.
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
        """What is wrong with control spheres, in words."""
        return tuple(s.finding for s in self.spheres if s.finding)

    def measures(self) -> dict[str, float]:
        """The figures that gates judge, by their names in a run."""
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
        outlines: per image, as the registration had them.
        taken: per image, outlines that are registration spheres.
        images: with T_scan_camera, metric; NaN for images without a pose, which count as if they were not there.
        spheres: registration and control spheres, scan frame.
        captures: of each image; of a capture in which control spheres are not seen, none is expected. None: all one.
        search: searches images for the outlines that lack; None: only `outlines` count.
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
    told = tuple(_told(row, off) for row in rows)
    return ControlEvaluation(means, told, tuple(map(tuple, scene.outlines)), tuple(assignments), located)


def _told(row: ControlSphere, off: dict[int, Array]) -> ControlSphere:
    """The row with its finding."""
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
    """The captures in which control spheres were placed: those that show one, or all if none does."""
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
    """Where to search for the outlines that lack, by image: near a place that is known, else wide."""
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
