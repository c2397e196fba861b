"""Jobs `develop` and `detect_spheres`: raw files developed, and the outlines that all registrations share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from typing import Any

import cv2
import numpy as np

from service.compute.camera_model import CameraModel
from service.compute.images.develop import develop, encode_tiff
from service.compute.images.develop_parameters import DevelopParameters
from service.compute.images.photographs import read_image
from service.compute.markers.detect import options_for
from service.compute.markers.grounded import GroundedDetector
from service.compute.markers.grounded_networks import Weights, weights_in
from service.compute.markers.image_files import LocatedOutlines, detect_all, locate_outlines, searched_whole
from service.compute.markers.paper import detect_file_by_masks
from service.compute.markers.records import SphereOutline, outline_from_record, outline_record
from service.compute.markers.refine import remeasure_file
from service.compute.scene import PosedImages, ScanSpheres
from service.core.geometry import Array
from service.jobs import detect_spheres as job
from service.jobs import develop as develop_job
from service.jobs.records import Hash, PosedPhotograph, has_poses
from service.jobs.structure_from_motion import ModelFile
from service.machine.resources import IMAGE_MB, processes_for
from service.worker.inputs import photographs, robot_camera_poses
from service.worker.job import JobAnswer, JobContext
from service.worker.records import camera_used


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
    files = photographs(context, images)
    workers = processes_for(len(files), IMAGE_MB)

    def show(done: int, total: int) -> None:
        context.progress("spheres in images", done, total)

    options = options_for(arguments.colour)
    camera = camera_used(arguments)
    if weights is not None:
        networks = GroundedDetector.of(weights, len(arguments.spheres_m), vote=arguments.detector == "vote")
        return searched_whole(detect_all(files, camera, options, 1, show, detect=networks))
    if arguments.detector == "paper":
        return searched_whole(detect_all(files, camera, options, workers, show, detect=detect_file_by_masks))
    if poses is None and not has_poses(arguments, images):
        return searched_whole(detect_all(files, camera, options, workers, show))
    return locate_outlines(
        files,
        PosedImages(
            robot_camera_poses(arguments, images) if poses is None else poses,
            camera,
            groups=_numbered(image.station for image in images),
            metric=poses is None,
        ),
        ScanSpheres(np.array(arguments.spheres_m), arguments.radius_m),
        scenes=_numbered(image.step for image in images),
        options=options,
        workers=workers,
        progress=show,
    )


def _numbered(names: Iterable[str]) -> list[int]:
    """Return a number for each name; equal names have equal numbers."""
    numbers: dict[str, int] = {}
    return [numbers.setdefault(name, len(numbers)) for name in names]


def develop_raw(context: JobContext[develop_job.Arguments]) -> JobAnswer:
    """Develop the raw file with the recorded parameters."""
    cv2.setNumThreads(1)
    arguments = context.arguments
    parameters = DevelopParameters(**arguments.parameters.model_dump())
    jpeg = read_image(context.input(arguments.jpeg))
    made = develop(context.input(arguments.raw), jpeg, parameters)
    tiff = context.keep_bytes(
        encode_tiff(made.image_bgr), kind="developed", media_type="image/tiff", name=f"{arguments.viewpoint}.tif"
    )
    answer = develop_job.Answer.model_validate({**asdict(made.how), "raw": arguments.raw})
    largest = 0.0 if made.how.largest_shift_px is None else made.how.largest_shift_px
    return JobAnswer({"largest_shift_px": largest}, (tiff,), answer)
