"""Step kind `evaluation`: the paper's errors on the control spheres, for each source of camera poses.

It evaluates the registrations that have arrived; a later one is evaluated when it arrives
(service/steps/due_jobs.py).
"""

from __future__ import annotations

from typing import Annotated, ClassVar

from service.computations import evaluate
from service.computations.registration import REGISTER, Registrations
from service.computations.scans import LOCATE_SPHERES
from service.core.errors import ConfigurationError
from service.core.jobs import Reference
from service.core.records.base import Record
from service.core.step_params import (
    NAMES_CAPTURE,
    NAMES_CT,
    NAMES_REGISTRATION,
    NAMES_SCAN,
    NAMES_SPHERES,
    RepeatedStep,
    StepParams,
)
from service.core.units import metres
from service.steps.context import JobRequest, StepContext, StepKind, StepOutcome
from service.steps.measures import Count, ErrorMm, MeasureRecord, Px, Ratio, RegistrationMeasures, Share
from service.steps.registration import captured_images
from service.steps.registration_jobs import recorded_registration_jobs

_SCAN, _CONTROL, _CT = "scan", "control_scan", "ct"  # fields of the job's arguments


class Params(StepParams):
    """The photographs and the scan that show the control spheres."""

    gives: ClassVar = "accuracy"
    repeated: ClassVar = RepeatedStep(
        "Compute it again; the same registration gives the same figures", same=True, device=False
    )

    registration: Annotated[str, NAMES_REGISTRATION]  # step whose registrations are evaluated
    images_of: Annotated[tuple[str, ...], NAMES_CAPTURE]  # capture steps that show the control spheres
    scan: Annotated[str, NAMES_SCAN]  # the registered scan
    # Scan or CT with the control spheres; None: each sphere is left out in turn.
    control_scan: Annotated[str | None, NAMES_SPHERES] = None
    ct: Annotated[str | None, NAMES_CT] = None  # CT import, for the loop closures of the error budget


class EvaluatedRegistration(MeasureRecord):
    """The paper's errors of one registration."""

    mean_radial_error_mm: Annotated[ErrorMm, "the paper's radial error, mean over the control spheres"] = None
    mean_reprojection_error_px: Annotated[Px, "the paper's reprojection error, mean over the control spheres"] = None


class Measures(RegistrationMeasures[EvaluatedRegistration]):
    """The errors of every registration, and of the best one."""

    best_mean_radial_error_mm: Annotated[
        ErrorMm, "mean radial error over the control spheres, of the registration that is used"
    ] = None
    best_predicted_error_mm: Annotated[ErrorMm, "predicted error of the registration that is used"] = None
    control_normalised_chi2: Annotated[
        Ratio, "radial errors against their predicted standard deviations: near 1 if those are right"
    ] = None
    control_spheres: Annotated[Count, "control spheres that were seen and measured"] = None
    control_spheres_expected: Annotated[Count, "control spheres that some image should show"] = None
    control_outlines_share: Annotated[
        Share, "measured of expected outlines, for the control sphere with the smallest share"
    ] = None
    worst_control_sphere_mm: Annotated[ErrorMm, "radial error of the worst control sphere"] = None


class Result(Record):
    """The paper's table, with one row for each registration, and the error budget of each."""

    table: tuple[evaluate.Row, ...]
    budgets: dict[str, evaluate.ErrorBudget]


def execute(context: StepContext, params: Params) -> StepOutcome:
    """Let the worker evaluate every registration that has arrived on the control spheres."""
    registrations = dict(context.earlier_result(params.registration, Registrations).registrations)
    references: dict[str, Reference | None] = {}
    found = recorded_registration_jobs(context.protocol, context.run, context.protocol.step(params.registration))
    arrived = {} if found is None else found.arrived
    registrations |= {name: REGISTER.read_answer(job.result) for name, job in arrived.items()}
    references |= {f"registrations/{name}": Reference(job.job, "result") for name, job in arrived.items()}
    scans = {_SCAN: params.scan, _CONTROL: params.control_scan, _CT: params.ct}
    measured = {
        name: None if step is None or step in context.run.skipped else context.earlier_answer(step, LOCATE_SPHERES)
        for name, step in scans.items()
    }
    references |= {name: found.reference("") for name, found in measured.items() if found is not None}
    spheres = {name: None if found is None else found.answer for name, found in measured.items()}
    scan = spheres[_SCAN]
    if scan is None:
        raise ConfigurationError(
            "an evaluation needs the registered scan",
            where=f"step {context.step.id}",
            remedy=f"Repeat step {params.scan}, which was skipped, then this one",
        )
    arguments = evaluate.Arguments(
        images=tuple(captured_images(context, params.images_of)),
        registrations=registrations,
        scan=scan,
        control_scan=spheres[_CONTROL],
        ct=spheres[_CT],
        radius_m=metres(context.protocol.spheres.radius_mm),
    )
    if context.protocol.spheres.colour is not None:
        arguments = arguments.model_copy(update={"colour": context.protocol.spheres.colour})
    (answer,) = context.evidence.run_jobs(JobRequest.of(evaluate.KIND, arguments, references))
    result = Result.model_validate(answer.result)
    for finding in min(result.table, key=lambda row: row.mean_radial_error_mm).findings:
        context.tell(f"{finding[0].upper()}{finding[1:]}")
    measures = Measures.read_all(answer.measures, registrations)
    return StepOutcome(measures, answer.artefacts, result, computed_by=(answer.source,))


KIND = StepKind(
    "evaluation",
    Params,
    Measures,
    Result,
    execute,
    registered_by=lambda params, steps: steps.get(params.registration),
)
