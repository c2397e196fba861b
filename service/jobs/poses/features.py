"""Job kind `features`: SIFT features of some images, a file for each."""

from __future__ import annotations

from typing import Any

from service.jobs.kind import JobKind, NoAnswer
from service.jobs.records import ImageFile, ImagesCamera


class FrontEndArguments(ImagesCamera):
    """Of features and of matches; `effort` are SfmOptions."""

    effort: dict[str, Any]


class Arguments(FrontEndArguments):
    """The images, and with which others they are to be matched as soon as these have features."""

    images: tuple[ImageFile, ...]
    match_with: tuple[str, ...] = ()


KIND = JobKind(
    name="features",
    arguments=Arguments,
    answer=NoAnswer,
    compute="service.worker.poses.front_end:features",
    words="features of the images",
    order=40,
    aside=True,
)
