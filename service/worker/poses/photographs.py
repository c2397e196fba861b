"""The photographs of a job as files, at full size or reduced."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import TypeVar

import cv2

from service.compute.camera_model import CameraModel
from service.compute.images.photographs import read_image
from service.compute.pixels.resample import resample
from service.compute.resources import IMAGE_MB, processes_for
from service.jobs.kind import JobRecord
from service.jobs.records import ImageFile, ImagesCamera
from service.worker.camera import camera_reduced, camera_used
from service.worker.job import JobContext

_A = TypeVar("_A", bound=ImagesCamera)
_J = TypeVar("_J", bound=JobRecord)
_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 97, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]


def photographs(context: JobContext[_A], images: Sequence[ImageFile]) -> list[Path]:
    """One file per image: the original, or a reduced copy if the job asks for it."""
    return photographs_at(context, images, camera_used(context.arguments), camera_reduced(context.arguments))


def photographs_at(
    context: JobContext[_J], images: Sequence[ImageFile], camera: CameraModel, full: CameraModel | None
) -> list[Path]:
    """One file per image at a camera's size: the original, or a copy reduced from that of the `full` camera."""
    originals = [context.input(image.sha256) for image in images]
    if full is None:
        return originals
    folder = context.scratch / f"{camera.width}x{camera.height}"
    folder.mkdir(exist_ok=True)
    copies = [folder / f"{image.viewpoint}.jpg" for image in images]
    reduce = partial(_reduce, full=full, width=camera.width, height=camera.height)
    with ProcessPoolExecutor(processes_for(len(images), IMAGE_MB), mp_context=get_context("spawn")) as pool:
        for done, _ in enumerate(pool.map(reduce, originals, copies), 1):
            context.progress(f"images at {camera.width} × {camera.height}", done, len(images))
    return copies


def _reduce(original: Path, copy: Path, full: CameraModel, width: int, height: int) -> None:
    cv2.setNumThreads(1)  # the pool already uses every core
    _, data = cv2.imencode(".jpg", resample(read_image(original), full, width, height), _JPEG)
    copy.write_bytes(data.tobytes())
