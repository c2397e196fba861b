"""The image of a job that looks at one image: kinds board_view, live_view, hand_view and hand_board."""

from __future__ import annotations

from service.core.run.state import JobState
from service.jobs.records import ImageFile


def image_of(job: JobState) -> ImageFile:
    """The photograph that such a job was given. Raises ValidationError for a job of another kind."""
    return ImageFile.model_validate(job.arguments["image"])
