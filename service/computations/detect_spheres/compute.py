"""Job `detect_spheres`: the outlines of the spheres, which all registrations share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from service.computations import detect_spheres as job
from service.computations.conversion import camera_used
from service.computations.inputs import photographs, robot_camera_poses
from service.computations.job import JobAnswer, JobContext
from service.computations.records import Hash, PosedPhotograph, has_poses
from service.computations.structure_from_motion import ModelFile
from service.compute.camera_model import CameraModel
from service.compute.markers.detect import options_for
from service.compute.markers.grounded import GroundedDetector, Weights, weights_in
from service.compute.markers.image_files import (
    DetectFile,
    LocatedOutlines,
    detect_all,
    locate_outlines,
    searched_whole,
)
from service.compute.markers.paper import Box, detect_file_by_masks
from service.compute.markers.records import DetectionOptions, SphereOutline, outline_from_record, outline_record
from service.compute.markers.refine import remeasure_file
from service.compute.scene import PosedImages, ScanSpheres
from service.core.geometry import Array
from service.machine.executors import IN_THIS_PROCESS
from service.machine.resources import IMAGE_MB, processes_for


def detect_spheres(context: JobContext[job.Arguments]) -> JobAnswer:
    """Detect the outlines of every sphere in every image, as one artefact that all registrations share.

    Poses predict where to search: the robot's, or those of a `model` from structure from motion, which has no scale.
    Without poses, or if they are too inaccurate, the images are searched whole. Images that are not in the model get
    no outlines.
    """
    arguments = context.arguments
    images, poses = _posed(context)
    weights = weights_in() if arguments.detector in ("grounded", "vote") else None
    located = _located(context, images, poses, weights)
    measured, lost = _measured(context, images, located.outlines)
    records = [[outline_record(outline) for outline in found] for found in measured]
    found = {image.viewpoint: [] for image in arguments.images}
    found |= dict(zip((image.viewpoint for image in images), records, strict=True))
    total = sum(map(len, records))
    ref = context.keep_json(found, kind="outlines", name="outlines.json")
    measures = {
        "outlines": float(total),
        "outlines_an_image": total / len(images),
        "images_searched_whole": float(located.count("searched")),
    } | lost
    if weights is None:
        return JobAnswer(measures, (ref,))
    used = {"detector": arguments.detector, "sha256": dict(weights.sha256())}
    return JobAnswer(measures, (ref, context.keep_json(used, kind="weights", name="weights.json")))


def read_outlines(
    read: Callable[[Hash], Any], outlines: Hash, images: Sequence[PosedPhotograph], camera: CameraModel
) -> list[list[SphereOutline]]:
    """Return the outlines in each image, from the file of `detect_spheres`; `read` gives the content of a file."""
    found = read(outlines)
    return [[outline_from_record(record, camera) for record in found[image.viewpoint]] for image in images]


def _posed(context: JobContext[job.Arguments]) -> tuple[Sequence[PosedPhotograph], Array | None]:
    """Return the images to search, and (N, 4, 4) their poses; None: those of the robot."""
    arguments = context.arguments
    if arguments.model is None:
        return arguments.images, None
    model = ModelFile.model_validate(context.input_json(arguments.model)).T_world_camera
    images = tuple(image for image in arguments.images if image.viewpoint in model)
    return images, np.array([model[image.viewpoint] for image in images])


def _measured(
    context: JobContext[job.Arguments],
    images: Sequence[PosedPhotograph],
    outlines: Sequence[tuple[SphereOutline, ...]],
) -> tuple[Sequence[tuple[SphereOutline, ...]], dict[str, float]]:
    """Return the outlines measured in developed raw files, where there are any, and how many these do not show."""
    arguments = context.arguments
    if arguments.developed is None:
        return outlines, {}
    camera, options = camera_used(arguments), options_for(arguments.colour)
    out: list[tuple[SphereOutline, ...]] = []
    for done, (image, found) in enumerate(zip(images, outlines, strict=True), 1):
        again = remeasure_file(context.input(arguments.developed[image.viewpoint]), camera, found, options)
        out.append(tuple(outline for outline in again if outline is not None))
        context.progress("spheres in developed raw files", done, len(images))
    lost = sum(map(len, outlines)) - sum(map(len, out))
    return out, {"outlines_not_in_raw": float(lost)}


def _located(
    context: JobContext[job.Arguments],
    images: Sequence[PosedPhotograph],
    poses: Array | None,
    weights: Weights | None,
) -> LocatedOutlines:
    arguments = context.arguments
    files, camera = photographs(context, images), camera_used(arguments)
    posed = None
    if arguments.detector == "classical" and (poses is not None or has_poses(arguments, images)):
        posed = PosedImages(
            robot_camera_poses(arguments, images) if poses is None else poses,
            camera,
            groups=_numbered(image.station for image in images),
            metric=poses is None,
        )
    return search_outlines(
        files,
        camera,
        posed,
        ScanSpheres(np.array(arguments.spheres_m), arguments.radius_m),
        detect=detector_of(arguments.detector, weights, len(arguments.spheres_m)),
        scenes=_numbered(image.step for image in images),
        options=options_for(arguments.colour),
        workers=processes_for(len(files), IMAGE_MB),
        progress=partial(context.progress, "spheres in images"),
    )


def detector_of(
    name: job.DetectorName,
    weights: Weights | None,
    least: int,
    boxes: Mapping[str, Sequence[Box]] | None = None,
) -> DetectFile | None:
    """Return a detector for single files, which searches whole images; None for the classical one.

    Args:
        name: the detector's name.
        weights: those of the networks, for `grounded` and `vote`.
        least: the number of spheres below which the networks' threshold falls.
        boxes: those of another detector by file name, for `paper`; None: it finds them itself.
    """
    if name == "paper":
        return partial(detect_file_by_masks, boxes=boxes)
    return None if weights is None else GroundedDetector.of(weights, least, vote=name == "vote")


def search_outlines(
    files: Sequence[Path],
    camera: CameraModel,
    posed: PosedImages | None,
    spheres: ScanSpheres,
    *,
    detect: DetectFile | None,
    options: DetectionOptions,
    workers: int,
    progress: Callable[[int, int], None],
    scenes: Sequence[int] | None = None,
) -> LocatedOutlines:
    """Search the outlines of the spheres in images: where their poses predict them, or everywhere.

    Args:
        files: N images of the camera's size.
        camera: their camera.
        posed: their poses; None: the images are searched whole.
        spheres: the spheres that the poses predict.
        detect: a detector that searches whole images; None: the classical one.
        options: the detector's options.
        workers: the number of processes.
        progress: called with the number of images done and of all.
        scenes: (N,) images of the same number show the same spheres; None: all do.

    Raises:
        DataError: an image cannot be used.
    """
    if detect is not None or posed is None:
        # One process has the networks, which use all cores by themselves.
        at_once = IN_THIS_PROCESS if isinstance(detect, GroundedDetector) else workers
        return searched_whole(detect_all(files, camera, options, at_once, progress, detect=detect))
    return locate_outlines(files, posed, spheres, scenes=scenes, options=options, workers=workers, progress=progress)


def _numbered(names: Iterable[str]) -> list[int]:
    """Return a number for each name; equal names have equal numbers."""
    numbers: dict[str, int] = {}
    return [numbers.setdefault(name, len(numbers)) for name in names]
