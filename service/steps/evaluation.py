"""Step kind `evaluation`: the paper's errors on the control spheres, for each source of camera poses.

It judges the registrations that are there; one that arrives later is evaluated then (service/steps/sources.py).
"""

from __future__ import annotations

from typing import Any

from service.core.records.events import Record
from service.steps.context import JobRequest, StepContext, StepKind, StepOutcome
from service.steps.inputs import captured_images, result_of
from service.steps.sources import registration_ways


class Params(Record):
    """Where the control spheres were seen and measured."""

    registration: str  # step whose registrations are judged
    images_of: tuple[str, ...]  # control captures
    scan: str  # the registered scan
    control_scan: str | None = None  # scan or CT that still holds the control spheres; None: spheres left out in turn
    ct: str | None = None  # CT import, for the loop closures of the error budget


class Result(Record):
    """The paper's table, one row a registration, and the error budget of each."""

    table: tuple[dict[str, Any], ...]
    budgets: dict[str, dict[str, Any]]


def execute(context: StepContext, params: Params) -> StepOutcome:
    """Let the worker evaluate every registration that has arrived on the control captures."""
    registrations = dict(result_of(context, params.registration)["registrations"])
    found = registration_ways(context.protocol, context.run, context.protocol.step(params.registration))
    if found is not None:
        registrations |= {name: dict(job.result) for name, job in found.arrived.items()}

    def unless_skipped(step: str | None) -> Any:
        return None if step is None or step in context.run.skipped else result_of(context, step)

    (answer,) = context.evidence.run_jobs(
        JobRequest(
            "evaluate",
            {
                "images": captured_images(context, params.images_of),
                "registrations": registrations,
                "scan": result_of(context, params.scan),
                "control_scan": unless_skipped(params.control_scan),
                "ct": unless_skipped(params.ct),
                "radius_m": context.protocol.spheres.radius_mm / 1000,
            },
        )
    )
    result = Result.model_validate(answer.result)
    return StepOutcome(answer.measures, answer.artefacts, result.model_dump(mode="json"))


KIND = StepKind("evaluation", Params, Result, execute)
