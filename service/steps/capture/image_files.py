"""The files of one exposure, put into the store."""

from __future__ import annotations

from drivers.interfaces import CapturedImage
from service.core.records.events import ArtefactRef
from service.steps.context import StepContext


def put_image(context: StepContext, image: CapturedImage, kind: str) -> tuple[ArtefactRef, ...]:
    """Put all files of an image into the store; `kind` is the artefact kind of its JPEG."""
    return tuple(
        context.evidence.put_file(
            file.path,
            kind=kind if file.media_type == "image/jpeg" else "raw",
            media_type=file.media_type,
            original_name=file.camera_name,
        )
        for file in image.files
    )
