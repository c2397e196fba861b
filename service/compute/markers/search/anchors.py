"""Provisional registration from a few images of each station, which predicts where spheres appear in all others."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.images.files import read_reduced
from service.compute.markers.cones import cone_of_sphere
from service.compute.markers.detect import find_rough
from service.compute.markers.observed_cones import ObservedCones
from service.compute.markers.outlines.refine import refine_outlines
from service.compute.markers.records import DetectionOptions, SphereOutline
from service.compute.markers.search.cone_pose import fit_pose
from service.compute.markers.search.predicted import WIDE, Tone, deviation, tone_of
from service.compute.registration.identity import Assignment, identify
from service.compute.registration.result import RegistrationResult
from service.compute.registration.solve import register
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import ComputeError
from service.core.geometry import Array, apply, inverse

_ANCHORS = (2, 4)  # images of a station that are searched first; the larger number if the first do not agree
_ANCHORS_WITHOUT_SCALE = (3, 6)
ANCHOR_WIDTH_PX = 1000  # least width of the reduced image on which an anchor is searched
_ANCHOR_CANDIDATES = 36  # circles examined in an anchor, those with the most votes
_SAME_SPHERE = 0.15  # in radii: largest distance of one unlisted sphere seen from two sides

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


class MapFunction(Protocol):
    """`map`, in this process or over several."""

    def __call__(self, work: Callable[[_Item], _Result], items: Iterable[_Item], /) -> Iterable[_Result]:
        """The results of `work` on the items, in their order."""
        ...


@dataclass(frozen=True, slots=True)
class AnchorRegistration:
    """The provisional registration.

    Attributes:
        T_scan_camera: (N, 4, 4).
        scale: of the poses' positions.
        margin: largest expected displacement of a sphere from its predicted place, in radii.
        tone: brightness of the spheres.
        unlisted_m: (U, 3) spheres in no list, scan frame.
        anchors: the images from which it was computed.
    """

    T_scan_camera: Array
    scale: float
    margin: float
    tone: Tone
    unlisted_m: Array
    anchors: tuple[int, ...]


def register_anchors(
    image_paths: Sequence[Path],
    images: PosedImages,
    spheres: ScanSpheres,
    sets: Sequence[NDArray[np.int64]],
    options: DetectionOptions,
    map_over: MapFunction,
) -> AnchorRegistration | None:
    """The registration of a few images of each of the `sets`; None if no reliable one is found."""
    seen: dict[int, tuple[SphereOutline, ...]] = {}
    look = partial(_look_reduced, camera=images.camera, options=options)
    nothing: tuple[SphereOutline, ...] = ()
    n = len(images.poses)
    for per_station in _ANCHORS if images.metric else _ANCHORS_WITHOUT_SCALE:
        chosen = [i for mine in sets for i in spread_views(images.poses, mine, per_station)]
        if len(chosen) > 0.5 * n:
            return None  # a search of whole images costs little more
        new = [i for i in chosen if i not in seen]
        seen |= dict(zip(new, map_over(look, [image_paths[i] for i in new]), strict=True))
        outlines = [seen.get(i, nothing) for i in range(n)]
        try:
            assignments = identify(outlines, images, spheres)
            solved = register(outlines, assignments, images, spheres)
        except ComputeError:
            continue  # more anchors may help; if not, the search of all images reports the error
        agreeing = {r.image for r in solved.residuals if not r.excluded}
        if all(len(agreeing.intersection(mine.tolist())) >= 2 for mine in sets):
            return _provisional(outlines, assignments, solved, spheres, tuple(sorted(seen)))
    return None


def _provisional(
    outlines: Sequence[Sequence[SphereOutline]],
    assignments: Sequence[Assignment],
    solved: RegistrationResult,
    spheres: ScanSpheres,
    anchors: tuple[int, ...],
) -> AnchorRegistration:
    listed = np.vstack([spheres.centres_m, spheres.control_m])
    used = sorted((r.image, r.outline) for r in solved.residuals if not r.excluded)
    T_scan_camera = solved.T_scan_camera
    off = [
        _pose_error(outlines[i], assignments[i], inverse(T_scan_camera[i]), listed, spheres.radius_m)
        for i in sorted({i for i, _ in used})
    ]
    return AnchorRegistration(
        T_scan_camera,
        solved.scale,
        # The anchors share part of their poses' error; the next image's may be several times as large.
        float(np.clip(0.03 + 4 * max(off), 0.05, WIDE)),
        tone_of([outlines[i][j] for i, j in used]),
        _unlisted(outlines, assignments, T_scan_camera, listed, spheres.radius_m),
        anchors,
    )


def _look_reduced(path: Path, camera: CameraModel, options: DetectionOptions) -> tuple[SphereOutline, ...]:
    """The clearest outlines of an anchor; identification needs only some, so doubtful ones are dropped."""
    image, smaller = read_reduced(path, camera, ANCHOR_WIDTH_PX)
    few = dataclasses.replace(options, max_candidates=min(_ANCHOR_CANDIDATES, options.max_candidates))
    roughs = find_rough(image, smaller, few)
    outlines = refine_outlines(image, smaller, [r.cone for r in roughs], few, scores=[r.score for r in roughs])
    kept: list[SphereOutline] = []
    for outline in outlines:
        if outline is not None and all(deviation(outline.cone, other.cone)[0] > 0.6 for other in kept):
            kept.append(outline)
    return tuple(kept)


def spread_views(poses: Array, members: NDArray[np.int64], count: int) -> list[int]:
    """Choose up to `count` of the images `members` with widely spread poses, by farthest-point sampling.

    The first is the one nearest to the median pose.
    """
    place = poses[members, :3, 3]
    spread = float(np.median(np.linalg.norm(place - np.median(place, axis=0), axis=1)))
    views = np.hstack([place / max(spread, 1e-12), poses[members, :3, 2]])
    chosen = [int(np.argmin(np.linalg.norm(views - np.median(views, axis=0), axis=1)))]
    while len(chosen) < min(count, len(members)):
        gap = np.min([np.linalg.norm(views - views[k], axis=1) for k in chosen], axis=0)
        chosen.append(int(np.argmax(gap)))
    return [int(members[k]) for k in chosen]


def _pose_error(
    outlines: Sequence[SphereOutline], assignment: Assignment, T: Array, spheres: Array, radius_m: float
) -> float:
    """Estimate a given pose's error: how far (in radii) the best pose from this image alone moves the spheres."""
    index = list(assignment.markers.items())
    if len(index) < 4:
        return 0.0
    centres = spheres[[m for _, m in index]]
    own = fit_pose(ObservedCones.of(outlines[j].cone for j, _ in index), centres, radius_m, T)
    moved = [
        deviation(cone_of_sphere(a, radius_m), cone_of_sphere(b, radius_m))[0]
        for a, b in zip(apply(own, centres), apply(T, centres), strict=True)
    ]
    return float(np.median(moved))


def _unlisted(
    outlines: Sequence[Sequence[SphereOutline]],
    assignments: Sequence[Assignment],
    T_scan_camera: Array,
    spheres: Array,
    radius_m: float,
) -> Array:
    """(U, 3) spheres in no list that two anchors show at one place."""
    rays: list[tuple[int, Array, Array, float]] = []  # image, origin, direction, half angle
    for i, found in enumerate(outlines):
        T = T_scan_camera[i]
        for j, outline in enumerate(found):
            if j in assignments[i].markers:
                continue
            place = apply(T, outline.centre_camera_m(radius_m))
            if len(spheres) and np.linalg.norm(spheres - place, axis=1).min() < 1.5 * radius_m:
                continue
            rays.append((i, T[:3, 3], T[:3, :3] @ outline.cone.axis, outline.cone.half_angle_rad))
    kept: list[Array] = []
    for (i, a, u, half_a), (k, b, v, half_b) in combinations(rays, 2):
        if i == k or abs(float(u @ v)) > 0.9999:
            continue
        s, t = np.linalg.lstsq(np.column_stack([u, -v]), b - a, rcond=None)[0]
        near_a, near_b = a + s * u, b + t * v
        middle = 0.5 * (near_a + near_b)
        if s < 2 * radius_m or t < 2 * radius_m or np.linalg.norm(near_a - near_b) > _SAME_SPHERE * radius_m:
            continue
        sizes = (np.arcsin(radius_m / s) / half_a, np.arcsin(radius_m / t) / half_b)
        if max(abs(size - 1) for size in sizes) < 0.04 and all(
            np.linalg.norm(middle - other) > 1.5 * radius_m for other in [*kept, *spheres]
        ):
            kept.append(middle)
    return np.array(kept).reshape(-1, 3)
