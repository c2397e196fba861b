"""Job `features`: the SIFT features of images, computed as images arrive or afterwards."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2

from service.computations import features as features_job
from service.computations.conversion import camera_used
from service.computations.features import FrontEndArguments
from service.computations.inputs import photographs
from service.computations.job import JobAnswer, JobContext
from service.computations.records import Hash
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
    context.progress("features", 0, len(images))
    extracted = front_end(context.arguments).extract_each(files)
    for number, (image, found) in enumerate(zip(images, extracted, strict=True), 1):
        count += len(found.pixels)
        name = f"{image.viewpoint}.features.npz"
        media_type = "application/octet-stream"
        refs.append(context.keep_bytes(found.to_bytes(), kind="sfm_features", media_type=media_type, name=name))
        context.progress("features", number, len(images))
    return JobAnswer({"features_an_image": count / len(images)}, tuple(refs))


def read_features(context: JobContext[Any], wanted: Mapping[str, Hash]) -> dict[str, ImageFeatures]:
    """Read features from their files, by image."""
    return {name: ImageFeatures.from_bytes(context.input(sha256).read_bytes()) for name, sha256 in wanted.items()}


def front_end(arguments: FrontEndArguments) -> FrontEnd:
    """Return the front end for a job: jobs run in parallel, so each uses this process alone, or the cluster."""
    return FrontEnd(camera_used(arguments), SfmOptions(**arguments.effort.set_fields()))
