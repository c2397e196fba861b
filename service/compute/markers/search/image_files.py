"""Searches image files for spheres: a few whole ones, which predict where to look in all others."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from service.compute.camera_model import CameraModel
from service.compute.images.files import read_image_of
from service.compute.markers.cones import Cone
from service.compute.markers.detect import detect_spheres
from service.compute.markers.records import DEFAULTS, DetectionOptions, SphereOutline
from service.compute.markers.search.anchors import AnchorRegistration, MapFunction, register_anchors
from service.compute.markers.search.nearby import find_nearby
from service.compute.markers.search.predicted import ImageOutlines, PredictedSpheres, find_outlines
from service.compute.registration.hypotheses import paired
from service.compute.registration.identity import Assignment
from service.compute.scene import PosedImages, ScanSpheres
from service.core.geometry import inverse
from service.logs.terminal import show_own_words_only

_MOST_FAILED = 0.4  # share of images whose prediction may fail before the prediction itself is doubted

Progress = Callable[[int, int], None]
DetectFile = Callable[[Path, CameraModel, DetectionOptions], tuple[SphereOutline, ...]]
_Item = TypeVar("_Item")
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

    `assignments` tells which outlines are registration spheres; None if every image was searched whole, so that they
    must still be identified. `ImageSearch.missing` numbers the registration spheres first, then the control spheres,
    then others that the anchors show.
    """

    outlines: tuple[tuple[SphereOutline, ...], ...]
    assignments: tuple[Assignment, ...] | None
    images: tuple[ImageSearch, ...]
    anchors: tuple[int, ...] = ()

    def count(self, how: Literal["searched", "predicted"]) -> int:
        """Number of images whose outlines were found in this way."""
        return sum(image.how == how for image in self.images)


@dataclass(frozen=True, slots=True)
class _Task:
    """One image file and the prediction for it. Without a prediction (None), the whole image is searched."""

    path: Path
    expected: PredictedSpheres | None = None


def detect_file(path: Path, camera: CameraModel, options: DetectionOptions) -> tuple[SphereOutline, ...]:
    """The outlines in one image file, searched whole.

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
    """The outlines in all images, in the given order, every image searched whole.

    Args:
        image_paths: JPEG, PNG or TIFF files of the camera's size.
        camera: intrinsics.
        options: of the detector.
        workers: number of processes; 1 computes in this one.
        progress: called with (done, total) after each image.
        detect: another detector for one file, which must be picklable; None: `detect_file`.

    Raises:
        DataError: an image cannot be used; the message names the first one.
    """
    with _mapping(workers, len(image_paths)) as map_over:
        work = partial(_detected, detect or detect_file, camera, options)
        return tuple(_counted(map_over(work, image_paths), len(image_paths), progress))


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
    """The outlines in all images, searched only where the poses predict spheres.

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
        options: of the detector.
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
    with _mapping(workers, n) as map_over:
        look = partial(_look, camera=images.camera, options=options)
        first = register_anchors(image_paths, images, spheres, [m for m in sets if len(m)], options, map_over)
        if first is None:
            found = tuple(_counted(map_over(look, [_Task(path) for path in image_paths]), n, progress))
            return searched_whole([f.outlines for f in found])
        known = len(spheres.centres_m)
        centres = np.vstack([spheres.centres_m, spheres.control_m, first.unlisted_m])
        tasks = [
            _Task(path, PredictedSpheres(inverse(T), centres, spheres.radius_m, first.margin, first.tone, known))
            for path, T in zip(image_paths, first.T_scan_camera, strict=True)
        ]
        found = tuple(_counted(map_over(look, tasks), n, progress))
        again = [i for i, f in enumerate(found) if f.spheres is not None]
        if len(again) < (1 - _MOST_FAILED) * n:
            whole = dict(zip(again, map_over(look, [_Task(image_paths[i]) for i in again]), strict=True))
            return searched_whole([whole.get(i, f).outlines for i, f in enumerate(found)])
    return _located(found, first, images.camera, spheres)


def _located(
    found: Sequence[ImageOutlines], first: AnchorRegistration, camera: CameraModel, spheres: ScanSpheres
) -> LocatedOutlines:
    """What was found at the predicted places, with the registration spheres identified."""
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
    """The outlines around expected spheres of image files, as `find_nearby` finds them in each.

    Raises:
        DataError: an image cannot be used; the message names the first one.
    """
    with _mapping(workers, len(expected)) as map_over:
        work = partial(_nearby, camera=camera, options=options)
        return tuple(_counted(map_over(work, expected), len(expected), progress))


def _nearby(
    task: tuple[Path, Sequence[tuple[Cone, float]]], camera: CameraModel, options: DetectionOptions
) -> tuple[SphereOutline, ...]:
    path, expected = task
    return find_nearby(read_image_of(path, camera), camera, expected, options)


def searched_whole(outlines: Sequence[tuple[SphereOutline, ...]]) -> LocatedOutlines:
    """`LocatedOutlines` for images searched whole, as by `detect_all`."""
    return LocatedOutlines(tuple(outlines), None, tuple(ImageSearch("searched") for _ in outlines))


def _look(task: _Task, camera: CameraModel, options: DetectionOptions) -> ImageOutlines:
    return find_outlines(read_image_of(task.path, camera), camera, task.expected, options)


@contextmanager
def _mapping(workers: int, items: int) -> Generator[MapFunction]:
    """A map over processes, or the plain one for a single worker."""
    if workers <= 1 or items <= 1:
        yield map
        return
    context = multiprocessing.get_context("spawn")  # forking a process with threads may deadlock
    with ProcessPoolExecutor(min(workers, items), mp_context=context, initializer=_one_thread) as pool:
        yield pool.map


def _one_thread() -> None:
    show_own_words_only()
    cv2.setNumThreads(1)


def _counted(results: Iterable[_Result], total: int, progress: Progress | None) -> Iterator[_Result]:
    for done, result in enumerate(results, 1):
        yield result
        if progress is not None:
            progress(done, total)
