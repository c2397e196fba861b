"""Job `develop`: a raw file, developed with the recorded parameters."""

from __future__ import annotations

from dataclasses import asdict

import cv2

from service.computations import develop as develop_job
from service.computations.job import JobAnswer, JobContext
from service.compute.images.develop import develop, encode_tiff
from service.compute.images.develop_parameters import DevelopParameters
from service.compute.images.photographs import read_image


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
