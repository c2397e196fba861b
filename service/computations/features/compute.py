"""Job `features`: the SIFT features of images, computed as images arrive or afterwards."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

import cv2

from service.computations import features as features_job
from service.computations.conversion import camera_used
from service.computations.features import FrontEndArguments
from service.computations.inputs import photographs
from service.computations.job import JobAnswer, JobContext
from service.computations.records import Hash
from service.compute.sfm.colmap_process import ColmapProcess
from service.compute.sfm.features import ImageFeatures
from service.compute.sfm.front_end import FrontEnd
from service.compute.sfm.options import SfmOptions


def features(context: JobContext[features_job.Arguments]) -> JobAnswer:
    """Compute SIFT features of some images, one artefact for each, in the order of the images."""
    cv2.setNumThreads(1)  # jobs run in parallel
    images = context.arguments.images
    files = photographs(context, images)
    refs = []
    count = 0
    with front_end(context.arguments) as front:
        for number, (image, file) in enumerate(zip(images, files, strict=True)):
            context.progress("features", number, len(images))
            found = front.extract_features(file)
            count += len(found.pixels)
            name = f"{image.viewpoint}.features.npz"
            media_type = "application/octet-stream"
            refs.append(context.keep_bytes(found.to_bytes(), kind="sfm_features", media_type=media_type, name=name))
    return JobAnswer({"features_an_image": count / len(images)}, tuple(refs))


def read_features(context: JobContext[Any], wanted: Mapping[str, Hash]) -> dict[str, ImageFeatures]:
    """Read features from their files, by image."""
    return {name: ImageFeatures.from_bytes(context.input(sha256).read_bytes()) for name, sha256 in wanted.items()}


class _ColmapChildren(threading.local):
    """COLMAP's child process of each thread, by seed; it stays, because starting one takes as long as an image."""

    def __init__(self) -> None:
        self.children: dict[int, ColmapProcess] = {}


_KEPT = _ColmapChildren()


def front_end(arguments: FrontEndArguments) -> FrontEnd:
    """Return the front end of COLMAP for a job, with the child process that this thread keeps."""
    options = SfmOptions(**arguments.effort.set_fields())
    child = _KEPT.children.setdefault(options.seed, ColmapProcess(seed=options.seed))
    return FrontEnd(camera_used(arguments), options, child=child)
