"""Registers the images of further cameras, with the raw files that the worker develops for their outlines."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

from service.computations import develop, further_camera
from service.computations.records import ImageFile
from service.compute.images.develop_parameters import PARAMETERS
from service.core.jobs import Reference
from service.core.records.events import FurtherExposure, ViewpointCaptured
from service.core.run.state import JobState
from service.steps.context import JobRequest, JobResult, StepContext
from service.steps.inputs import raw_of
from service.steps.registration_sources import most_preferred


@dataclass(frozen=True, slots=True)
class ExposureFiles:
    """The two files of an exposure, by their SHA-256."""

    viewpoint: str
    jpeg: str
    raw: str


def developed(context: StepContext, exposures: Sequence[ExposureFiles]) -> dict[str, str]:
    """Return the developed raw file of each exposure of one camera, by viewpoint."""
    requests = [
        JobRequest.of(
            develop.KIND,
            develop.Arguments(viewpoint=one.viewpoint, raw=one.raw, jpeg=one.jpeg, parameters=PARAMETERS),
        )
        for one in exposures
    ]
    results = context.evidence.run_jobs(*requests)
    return {one.viewpoint: result.artefacts[0].sha256 for one, result in zip(exposures, results, strict=True)}


_SHARED = ("spheres_m", "sphere_covariance_m2", "radius_m", "colour")  # arguments of the search for outlines

_OF_REGISTRATION = ("T_world_scan", "covariance", "T_scan_camera", "camera", "outlines")  # parts of its answer
_OF_LENS = ("intrinsics_covariance",)


def locate_further_cameras(
    context: StepContext,
    images_of: Iterable[str],
    outlines: JobRequest,
    registered: Mapping[str, JobState],
    *,
    on_raw: bool,
) -> Mapping[str, JobResult]:
    """Locate each further camera that exposed in these capture steps; return the worker's answers by camera name.

    Args:
        context: the registration step's surroundings: devices, evidence, clock.
        images_of: the capture steps' ids.
        outlines: the search for spheres in the first camera's images, which has the arguments on the spheres.
        registered: the finished job of each registration of those images.
        on_raw: true to measure in developed raw files, for a camera that wrote one with every image.
    """
    exposures = sorted(_exposures(context, images_of), key=lambda exposure: exposure[1].device)
    requests = {
        device: _request(context, [*group], outlines, registered, on_raw=on_raw)
        for device, group in groupby(exposures, lambda exposure: exposure[1].device)
    }
    return dict(zip(requests, context.evidence.run_jobs(*requests.values()), strict=True)) if requests else {}


def _exposures(context: StepContext, images_of: Iterable[str]) -> list[tuple[str, FurtherExposure]]:
    """Return (viewpoint, exposure) of every usable view."""
    return [
        (capture.viewpoint, exposure)
        for step in images_of
        for capture in context.evidence.captures(step)
        if isinstance(capture, ViewpointCaptured) and all(capture.verdicts.values())
        for exposure in capture.further
    ]


def _request(
    context: StepContext,
    exposures: Sequence[tuple[str, FurtherExposure]],
    outlines: JobRequest,
    registered: Mapping[str, JobState],
    *,
    on_raw: bool,
) -> JobRequest:
    """Return the job for one camera; its newest calibration counts."""
    last = exposures[-1][1]
    recorded = outlines.arguments
    arguments: dict[str, object] = {
        "device": last.device,
        "mounted": last.mounted,
        "images": [
            ImageFile(viewpoint=viewpoint, sha256=exposure.artefacts[0].sha256).plain()
            for viewpoint, exposure in exposures
        ],
        "calibration": last.calibration.sha256,
        **{name: recorded[name] for name in _SHARED if name in recorded},
    }
    raws = [(viewpoint, one, raw_of(one.artefacts)) for viewpoint, one in exposures]
    taken = [
        ExposureFiles(viewpoint, one.artefacts[0].sha256, raw) for viewpoint, one, raw in raws if raw is not None
    ]
    if on_raw and len(taken) == len(exposures):
        arguments["developed"] = developed(context, taken)
    if last.mounted == "rigid":
        job = registered[most_preferred(registered)]
        first = {name: Reference(job.job, f"result/{name}").record() for name in _OF_REGISTRATION}
        arguments["first"] = first | {name: recorded[name] for name in _OF_LENS if name in recorded}
    return JobRequest(further_camera.KIND.name, arguments, version=further_camera.KIND.version)
