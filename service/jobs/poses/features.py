"""Job kind `features`: SIFT features of some images, one file for each."""

from __future__ import annotations

from typing import Any

from service.jobs.kind import JobKind, JobRecord, NoAnswer
from service.jobs.records import ImageFile, ImagesCamera


class FrontEndArguments(ImagesCamera):
    """Arguments that features and matches share; `effort` holds SfmOptions."""

    effort: dict[str, Any]


class ImagesToMatch(JobRecord):
    """The images, and the viewpoints that they are to be matched with as soon as those have features."""

    images: tuple[ImageFile, ...]
    match_with: tuple[str, ...] = ()


class Arguments(ImagesToMatch, FrontEndArguments):
    """The images, and the viewpoints that they are to be matched with as soon as those have features."""


KIND = JobKind(
    name="features",
    arguments=Arguments,
    answer=NoAnswer,
    compute="service.worker.poses.front_end:features",
    words="features of the images",
    order=40,
    aside=True,
)
