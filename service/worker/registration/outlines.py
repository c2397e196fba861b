"""Job `detect_spheres`: outlines of the spheres in the images, as one file that all registrations share."""

from __future__ import annotations

import os
from collections.abc import Iterable

import numpy as np

from service.compute.markers.archive import outline_record
from service.compute.markers.detectors import options_for
from service.compute.markers.search.image_files import detect_all, locate_outlines, searched_whole
from service.compute.markers.search.paper_files import detect_file_by_masks
from service.compute.scene import PosedImages, ScanSpheres
from service.jobs.registration import detect_spheres as job
from service.worker.camera import camera_used
from service.worker.job import JobAnswer, JobContext
from service.worker.poses.photographs import photographs
from service.worker.poses.robot_poses import robot_camera_poses


def detect_spheres(context: JobContext[job.Arguments]) -> JobAnswer:
    """Outlines of every sphere in every image, as one artefact that all registrations share.

    The robot's poses tell where to look, or those of a `model` from structure from motion, which has no scale; where
    they are too far off, the images are searched whole. An image without a pose in the model gets no outlines.
    """
    arguments = context.arguments
    everyone = images = arguments.images
    model = None if arguments.model is None else context.input_json(arguments.model)["T_world_camera"]
    if model is not None:
        images = tuple(image for image in images if image.viewpoint in model)
    files = photographs(context, images)
    workers = min(len(files), os.cpu_count() or 1)

    def show(done: int, total: int) -> None:
        context.progress("spheres in images", done, total)

    options = options_for(arguments.colour)
    camera = camera_used(arguments)
    if arguments.detector == "paper":
        located = searched_whole(detect_all(files, camera, options, workers, show, detect=detect_file_by_masks))
    else:
        located = locate_outlines(
            files,
            PosedImages(
                robot_camera_poses(arguments, images)
                if model is None
                else np.array([model[image.viewpoint] for image in images]),
                camera,
                groups=_numbered(image.station for image in images),
                metric=model is None,
            ),
            ScanSpheres(np.array(arguments.spheres_m), arguments.radius_m),
            scenes=_numbered(image.step for image in images),
            options=options,
            workers=workers,
            progress=show,
        )
    records = [[outline_record(outline) for outline in found] for found in located.outlines]
    found = {image.viewpoint: [] for image in everyone}
    found |= dict(zip((image.viewpoint for image in images), records, strict=True))
    total = sum(map(len, records))
    ref = context.keep_json(found, kind="outlines", name="outlines.json")
    measures = {
        "outlines": float(total),
        "outlines_an_image": total / len(images),
        "images_searched_whole": float(located.count("searched")),
    }
    return JobAnswer(measures, (ref,))


def _numbered(names: Iterable[str]) -> list[int]:
    """A number for each name, the same for the same."""
    numbers: dict[str, int] = {}
    return [numbers.setdefault(name, len(numbers)) for name in names]
