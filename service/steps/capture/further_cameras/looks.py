"""The jobs that look at the images of further cameras as they arrive, and one line on each for the technician."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from service.core.jobs.priorities import LIVE
from service.core.jobs.references import Each, Reference
from service.core.records.events import FurtherExposure, ViewpointCaptured
from service.core.run.state import JobState
from service.jobs.capture import further_view
from service.jobs.looks import image_of
from service.jobs.records import ImageFile, Point
from service.steps.context import JobRequest, StepContext


def look_at_further(
    context: StepContext,
    spheres_m: Sequence[Point],
    radius_m: float,
    references: Mapping[str, Reference | Each | None],
) -> None:
    """Enqueue the job on every new image of a further camera in this step. Returns at once.

    Args:
        context: of the capture step.
        spheres_m: centres in the CT.
        radius_m: of the spheres.
        references: what is recorded instead of `spheres_m`.
    """
    jobs = context.evidence.jobs(context.step.id)
    begun = {image_of(job).sha256 for job in jobs if job.kind == further_view.KIND.name}
    for viewpoint, exposure in _exposures(context):
        sha256 = exposure.artefacts[0].sha256
        if sha256 in begun:
            continue
        arguments = further_view.Arguments(
            device=exposure.device,
            image=ImageFile(viewpoint=viewpoint, sha256=sha256),
            calibration=exposure.calibration.sha256,
            spheres_m=tuple(spheres_m),
            radius_m=radius_m,
        )
        request = JobRequest.of(further_view.KIND, arguments, {"spheres_m": references["spheres_m"]}, LIVE)
        context.evidence.enqueue(request, sha256)


def _exposures(context: StepContext) -> list[tuple[str, FurtherExposure]]:
    """(viewpoint, exposure) of every usable view of the step."""
    return [
        (capture.viewpoint, exposure)
        for capture in context.evidence.captures(context.step.id)
        if isinstance(capture, ViewpointCaptured) and all(capture.verdicts.values())
        for exposure in capture.further
    ]


def describe_further(job: JobState) -> str:
    """One line on one image: `v1_005, side: 7/8 spheres, 0.18 px`, or what is wrong with it."""
    viewpoint = image_of(job).viewpoint
    if job.status == "failed":
        return f"{viewpoint}, further camera: could not be analysed: {job.message}"
    m, answer = job.measures, further_view.KIND.read_answer(job.result)
    if answer.reason:
        return f"{viewpoint}, {answer.device}: this image does not locate it: {answer.reason}"
    return (
        f"{viewpoint}, {answer.device}: {m['spheres_seen']:.0f}/{m['spheres_expected']:.0f} spheres, "
        f"{m['outline_rms_px']:.2f} px"
    )
