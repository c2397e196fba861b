"""Develops a raw file with fixed parameters; job and command `develop` both call `develop_file`."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path

import cv2

from service.computations import develop as job
from service.computations.job import JobAnswer, JobContext
from service.compute.images.develop import Development, develop, encode_tiff
from service.compute.images.photographs import read_image
from service.compute.photography import DevelopParameters


@dataclass(frozen=True, slots=True)
class DevelopedFile:
    """A linear TIFF of 16 bits, and how it was made."""

    tiff: bytes = field(repr=False)
    how: Development


def develop_file(raw: Path, jpeg: Path | None, parameters: DevelopParameters) -> DevelopedFile:
    """Develop a raw file.

    Args:
        raw: the raw file.
        jpeg: the JPEG of the same exposure, which gives the picture its size and checks its place; None without one.
        parameters: the parameters.

    Raises:
        DataError: a file cannot be used, or the two do not show the same.
        ConfigurationError: rawpy is not installed, or does not know a parameter.
    """
    made = develop(raw, None if jpeg is None else read_image(jpeg), parameters)
    return DevelopedFile(encode_tiff(made.image_bgr), made.how)


def develop_raw(context: JobContext[job.Arguments]) -> JobAnswer:
    """Develop the raw file of a job with the recorded parameters."""
    cv2.setNumThreads(1)
    arguments = context.arguments
    made = develop_file(context.input(arguments.raw), context.input(arguments.jpeg), arguments.parameters)
    tiff = context.keep_bytes(made.tiff, kind="developed", media_type="image/tiff", name=f"{arguments.viewpoint}.tif")
    answer = job.Answer.model_validate({**asdict(made.how), "raw": arguments.raw})
    return JobAnswer({"largest_shift_px": made.how.largest_shift_px or 0.0}, (tiff,), answer)
