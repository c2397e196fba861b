"""Step kind `layout_check`: photographs of the placed spheres, taken by hand, tell whether they are too symmetric."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from service.core.model import ArtefactRef, Record
from service.steps.arrivals import keep
from service.steps.capture import photograph
from service.steps.context import JobRequest, StepContext, StepKind, StepOutcome
from service.steps.exposure import wanted_settings


class Params(Record):
    """What the photographs must show."""

    photographs: int = 1  # more are merged, when one cannot show every sphere; the camera is moved in between
    between_s: float = 5.0  # for moving the camera
    sensor_width_mm: float = 35.7  # with the focal length of the file, a camera that is not calibrated yet


class Result(Record):
    """The spheres as the photographs show them, in the first camera's frame, metres; good to some millimetres."""

    spheres_m: tuple[tuple[float, float, float], ...]
    details: dict[str, Any]


def execute(context: StepContext, params: Params) -> StepOutcome:
    """Take the photographs, let the worker find the spheres and search for near-symmetries; nothing moves."""
    camera = context.devices.camera()
    kept: list[ArtefactRef] = []
    images: list[dict[str, Any]] = []
    for number in range(params.photographs):
        context.checkpoint()
        context.progress("photographs of the spheres", number, params.photographs)
        if number:
            context.wait(params.between_s)
        with tempfile.TemporaryDirectory(prefix="orthocapture-") as folder:
            image = photograph(context, camera, wanted_settings(context), Path(folder))
            ref = keep(
                context, image.jpeg.path, device="camera", kind="layout_image", media_type=image.jpeg.media_type
            )
        kept.append(ref)
        images.append({"sha256": ref.sha256, "focal_mm": image.focal_length_mm})
    arguments = {
        "images": images,
        "sensor_width_mm": params.sensor_width_mm,
        "radius_m": context.protocol.spheres.radius_mm / 1000,
    }
    (answer,) = context.evidence.run_jobs(JobRequest("layout", arguments))
    result = Result.model_validate(answer.result)
    return StepOutcome(answer.measures, (*kept, *answer.artefacts), result.model_dump(mode="json"))


KIND = StepKind("layout_check", Params, Result, execute)
