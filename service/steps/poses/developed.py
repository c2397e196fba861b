"""The raw files of exposures, developed by the worker for the measurement of outlines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

from service.compute.images.develop_parameters import PARAMETERS
from service.jobs.registration import develop
from service.steps.context import JobRequest, StepContext


@dataclass(frozen=True, slots=True)
class ExposureFiles:
    """The two files of an exposure, by their SHA-256."""

    viewpoint: str
    jpeg: str
    raw: str


def developed(context: StepContext, exposures: Sequence[ExposureFiles]) -> dict[str, str]:
    """The developed raw file of each exposure of one camera, by viewpoint."""
    parameters = develop.Parameters.model_validate(asdict(PARAMETERS))
    requests = [
        JobRequest.of(
            develop.KIND,
            develop.Arguments(viewpoint=one.viewpoint, raw=one.raw, jpeg=one.jpeg, parameters=parameters),
        )
        for one in exposures
    ]
    results = context.evidence.run_jobs(*requests)
    return {one.viewpoint: result.artefacts[0].sha256 for one, result in zip(exposures, results, strict=True)}
