"""Searches image files for spheres: a few whole ones, whose registration predicts where to look in all others."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.images.photographs import read_image_of, read_reduced
from service.compute.markers.cones import Cone, ObservedCones, cone_of_sphere, fit_pose
from service.compute.markers.detect import detect_spheres, find_rough
from service.compute.markers.predicted import (
    WIDE,
    ImageOutlines,
    PredictedSpheres,
    Tone,
    deviation,
    find_nearby,
    find_outlines,
    tone_of,
)
from service.compute.markers.records import DEFAULTS, DetectionOptions, SphereOutline
from service.compute.markers.refine import refine_outlines
from service.compute.registration.hypotheses import paired
from service.compute.registration.identity import Assignment, identify
from service.compute.registration.result import RegistrationResult
from service.compute.registration.solve import register
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import ComputeError
from service.core.geometry import Array, apply, inverse
from service.machine.executors import MapFunction, mapping, report_each

_MOST_FAILED = 0.4  # share of images whose prediction may fail before the prediction itself is doubted

Progress = Callable[[int, int], None]
DetectFile = Callable[[Path, CameraModel, DetectionOptions], tuple[SphereOutline, ...]]
_Result = TypeVar("_Result")


@dataclass(frozen=True, slots=True)
class ImageSearch:
    """How the outlines of one image were found; `missing` holds expected spheres not found, with reasons."""

    how: Literal["searched", "predicted"]
    expected: int = 0
    missing: dict[int, str] = field(default_factory=dict[int, str])


@dataclass(frozen=True, slots=True)
class LocatedOutlines:
    """Outlines of all images and how they were found.

    `assignments` says which outlines are registration spheres; None if every image was searched whole, so that they
    must still be identified. `ImageSearch.missing` numbers the registration spheres first, then the control spheres,
    then others that the anchors show.
    """

    outlines: tuple[tuple[SphereOutline, ...], ...]
    assignments: tuple[Assignment, ...] | None
    images: tuple[ImageSearch, ...]
    anchors: tuple[int, ...] = ()

    def count(self, how: Literal["searched", "predicted"]) -> int:
        """Return the number of images whose outlines were found in this way."""
        return sum(image.how == how for image in self.images)


@dataclass(frozen=True, slots=True)
class _Task:
    """One image file and the prediction for it. Without a prediction (None), the whole image is searched."""

    path: Path
    expected: PredictedSpheres | None = None


def detect_file(path: Path, camera: CameraModel, options: DetectionOptions) -> tuple[SphereOutline, ...]:
    """Detect the outlines in one image file, searched whole.

    Raises:
        DataError: the file is missing, truncated, no image or not of the camera's size; `where` names it.
    """
    return detect_spheres(read_image_of(path, camera), camera, options)


def detect_all(
    image_paths: Sequence[Path],
    camera: CameraModel,
    options: DetectionOptions = DEFAULTS,
    workers: int = 1,
    progress: Progress | None = None,
    detect: DetectFile | None = None,
) -> tuple[tuple[SphereOutline, ...], ...]:
    """Detect the outlines in all images, in the given order, every image searched whole.

    Args:
        image_paths: JPEG, PNG or TIFF files of the camera's size.
        camera: intrinsics.
        options: the detector's options.
        workers: number of processes; 1 computes in this one.
        progress: called with (done, total) after each image.
        detect: another detector for one file, which must be picklable; None: `detect_file`.

    Raises:
        DataError: an image cannot be used; the message names the first one.
    """
    with mapping(workers, len(image_paths)) as map_over:
        work = partial(_detected, detect or detect_file, camera, options)
        return tuple(report_each(map_over(work, image_paths), len(image_paths), progress))


def _detected(
    detect: DetectFile, camera: CameraModel, options: DetectionOptions, path: Path
) -> tuple[SphereOutline, ...]:
    return detect(path, camera, options)


def locate_outlines(
    image_paths: Sequence[Path],
    images: PosedImages,
    spheres: ScanSpheres,
    *,
    scenes: Sequence[int] | NDArray[np.int64] | None = None,
    options: DetectionOptions = DEFAULTS,
    workers: int = 1,
    progress: Progress | None = None,
) -> LocatedOutlines:
    """Detect the outlines in all images, searched only where the poses predict spheres.

    A few images of each station, spread over its poses, are searched whole at reduced size. Their identification and
    a provisional registration predict every sphere in every image, and how far the poses may be off. An image with
    too few spheres at their predicted places is searched whole; if there are too many such images, or if the anchors
    do not agree, all images are.

    Args:
        image_paths: N JPEG, PNG or TIFF files of the camera's size.
        images: their camera and poses.
        spheres: registration and control spheres.
        scenes: (N,) images of the same number show the same spheres; between numbers, spheres that are in no list may
            have come or gone. None: all the same.
        options: the detector's options.
        workers: number of processes; 1 computes in this one.
        progress: called with (done, total) after each image.

    Raises:
        DataError: lengths do not agree, or an image cannot be used; the message names the first one.
    """
    n = len(image_paths)
    images.require(n)
    stations = images.stations
    shown = np.zeros(n, dtype=np.int64) if scenes is None else np.asarray(scenes, dtype=np.int64)
    sets = [np.nonzero((stations == g) & (shown == s))[0] for g in np.unique(stations) for s in np.unique(shown)]
    with mapping(workers, n) as map_over:
        look = partial(_look, camera=images.camera, options=options)
        first = _register_anchors(image_paths, images, spheres, [m for m in sets if len(m)], options, map_over)
        if first is None:
            found = tuple(report_each(map_over(look, [_Task(path) for path in image_paths]), n, progress))
            return searched_whole([f.outlines for f in found])
        known = len(spheres.centres_m)
        centres = np.vstack([spheres.centres_m, spheres.control_m, first.unlisted_m])
        tasks = [
            _Task(path, PredictedSpheres(inverse(T), centres, spheres.radius_m, first.margin, first.tone, known))
            for path, T in zip(image_paths, first.T_scan_camera, strict=True)
        ]
        found = tuple(report_each(map_over(look, tasks), n, progress))
        again = [i for i, f in enumerate(found) if f.spheres is not None]
        if len(again) < (1 - _MOST_FAILED) * n:
            whole = dict(zip(again, map_over(look, [_Task(image_paths[i]) for i in again]), strict=True))
            return searched_whole([whole.get(i, f).outlines for i, f in enumerate(found)])
    return _located(found, first, images.camera, spheres)


def _located(
    found: Sequence[ImageOutlines], first: AnchorRegistration, camera: CameraModel, spheres: ScanSpheres
) -> LocatedOutlines:
    """Combine the outlines found at the predicted places, with the registration spheres identified."""
    centres = np.vstack([spheres.centres_m, spheres.control_m, first.unlisted_m])
    assignments: list[Assignment] = []
    for f, T in zip(found, first.T_scan_camera, strict=True):
        if f.spheres is None:
            named = paired(f.outlines, inverse(T), centres, spheres.radius_m, camera)
        else:
            named = dict(enumerate(f.spheres))
        markers = {d: m for d, m in named.items() if m < len(spheres.centres_m)}
        assignments.append(Assignment(markers, inverse(T), first.scale))
    return LocatedOutlines(
        tuple(f.outlines for f in found),
        tuple(assignments),
        tuple(
            ImageSearch("searched")
            if f.spheres is None
            else ImageSearch("predicted", len(f.spheres) + len(f.missing), f.missing)
            for f in found
        ),
        first.anchors,
    )


def search_nearby(
    expected: Sequence[tuple[Path, Sequence[tuple[Cone, float]]]],
    camera: CameraModel,
    options: DetectionOptions = DEFAULTS,
    workers: int = 1,
    progress: Progress | None = None,
) -> tuple[tuple[SphereOutline, ...], ...]:
    """Search image files for outlines around expected spheres, as `find_nearby` finds them in each.

    Raises:
        DataError: an image cannot be used; the message names the first one.
    """
    with mapping(workers, len(expected)) as map_over:
        work = partial(_nearby, camera=camera, options=options)
        return tuple(report_each(map_over(work, expected), len(expected), progress))


def _nearby(
    task: tuple[Path, Sequence[tuple[Cone, float]]], camera: CameraModel, options: DetectionOptions
) -> tuple[SphereOutline, ...]:
    path, expected = task
    return find_nearby(read_image_of(path, camera), camera, expected, options)


def searched_whole(outlines: Sequence[tuple[SphereOutline, ...]]) -> LocatedOutlines:
    """Return `LocatedOutlines` for images searched whole, as by `detect_all`."""
    return LocatedOutlines(tuple(outlines), None, tuple(ImageSearch("searched") for _ in outlines))


def _look(task: _Task, camera: CameraModel, options: DetectionOptions) -> ImageOutlines:
    return find_outlines(read_image_of(task.path, camera), camera, task.expected, options)


_ANCHORS = (2, 4)  # images of a station that are searched first; the larger number if the first do not agree
_ANCHORS_WITHOUT_SCALE = (3, 6)
ANCHOR_WIDTH_PX = 1000  # least width of the reduced image on which an anchor is searched
_ANCHOR_CANDIDATES = 36  # circles examined in an anchor, those with the most votes
_SAME_SPHERE = 0.15  # in radii: largest distance of one unlisted sphere seen from two sides


@dataclass(frozen=True, slots=True)
class AnchorRegistration:
    """The provisional registration by a few images, the anchors.

    Attributes:
        T_scan_camera: (N, 4, 4) provisional camera poses in the scan frame.
        scale: scale of the poses' positions.
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


def _register_anchors(
    image_paths: Sequence[Path],
    images: PosedImages,
    spheres: ScanSpheres,
    sets: Sequence[NDArray[np.int64]],
    options: DetectionOptions,
    map_over: MapFunction,
) -> AnchorRegistration | None:
    """Return the registration of a few images of each of the `sets`; None if no reliable one is found."""
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
    """Return the clearest outlines of an anchor; identification needs only some, so doubtful ones are dropped."""
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
    """Return (U, 3) spheres in no list that two anchors show at one place."""
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
