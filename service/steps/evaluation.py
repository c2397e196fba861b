"""Step kind `evaluation`: the paper's errors on the control spheres, for each source of camera poses."""

from __future__ import annotations

from typing import Any

from service.core.model import Record
from service.steps.context import JobRequest, StepContext, StepKind, StepOutcome
from service.steps.inputs import captured_images, result_of


class Params(Record):
    """Where the control spheres were seen and measured."""

    registration: str
    images_of: tuple[str, ...]  # control captures
    calibration: str
    scan: str  # the registered scan
    control_scan: str  # scan or CT that still holds the control spheres


class Result(Record):
    """The paper's table: one row a source of poses."""

    table: tuple[dict[str, Any], ...]


def execute(context: StepContext, params: Params) -> StepOutcome:
    """Let the worker evaluate every registration on the control captures."""
    registration = result_of(context, params.registration)
    (answer,) = context.evidence.run_jobs(
        JobRequest(
            "evaluate",
            {
                "images": captured_images(context, params.images_of),
                "camera": result_of(context, params.calibration)["camera"],
                "outlines": registration["outlines_sha256"],
                "registrations": registration["registrations"],
                "spheres_m": result_of(context, params.scan)["spheres_m"],
                "control_scan_spheres_m": result_of(context, params.control_scan)["spheres_m"],
                "radius_m": context.protocol.spheres.radius_mm / 1000,
            },
        )
    )
    result = Result.model_validate(answer.result)
    return StepOutcome(answer.measures, answer.artefacts, result.model_dump(mode="json"))


KIND = StepKind("evaluation", Params, Result, execute)
