"""Step kind `registration`: T_world_scan from every image and marker, for each source of camera poses.

The step waits for the sources that its gates and those of the evaluation name, and for the robot's poses, which take
seconds. The others are computed while the run goes on (service/steps/registration_jobs.py).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated

from pydantic import Field

from service.computations import term
from service.computations.further_cameras import FURTHER_CAMERA, FurtherCameraAnswer
from service.computations.registration import DETECT_SPHERES, REGISTER, Registration
from service.core.errors import ComputeError
from service.core.jobs import arguments_name
from service.core.records.base import Record
from service.core.records.run_events import ComputedBy
from service.steps.context import JobResult, StepContext, StepKind, StepOutcome
from service.steps.measures import Count, ErrorMm, Measure, MeasureRecord, Px, Ratio, RegistrationMeasures
from service.steps.registration import PLANNED, RegistrationParams, decisive, search_for_spheres
from service.steps.registration_jobs import RegistrationJobs, locate_further_cameras, registration_jobs


class OneRegistration(MeasureRecord):
    """The measures of one registration."""

    rms_px: Annotated[Px, "rms distance of the outlines' points from the predicted outlines"] = None
    chi2_reduced: Annotated[
        Ratio, "chi-squared per degree of freedom: near 1 if the stated covariances are right"
    ] = None
    markers: Annotated[Count, "spheres that take part"] = None
    images: Annotated[Count, "images that take part"] = None
    excluded_outlines: Annotated[Count, "outlines left out as outliers"] = None
    images_left_out: Annotated[Count, "images left out because they contradict the others"] = None
    contradictions: Annotated[Count, "contradictions between the inputs that somebody has to look at"] = None
    predicted_error_mm: Annotated[ErrorMm, "predicted error at the centre of the spheres"] = None
    leave_one_out_mm: Annotated[ErrorMm, "mean radial error of each registration sphere as the others predict it"] = (
        None
    )


_CONSISTENCY = ("consistency_mm", "consistency_mrad")  # measures of the job that locates a further camera


class Measures(RegistrationMeasures[OneRegistration]):
    """The measures of the outlines, and of every registration."""

    outlines: Annotated[Count, "outlines of spheres found in all images"] = None
    outlines_an_image: Annotated[Count, "outlines found in an image, on average"] = None
    images_searched_whole: Annotated[Count, "images that were searched whole because no pose said where to look"] = (
        None
    )
    outlines_not_in_raw: Annotated[Count, "outlines of the JPEGs that the developed raw files do not show"] = None
    further_views: Annotated[Count, "images that locate a further camera, for the one that has fewest"] = None
    further_excluded: Annotated[
        Count, "images of further cameras without four spheres, or that contradict the rest"
    ] = None
    further_consistency_mm: Annotated[
        ErrorMm, "rms distance between the poses of a further camera by single images and by all, for the worst one"
    ] = None
    further_consistency_mrad: Annotated[
        float | None,
        Measure("mrad", 1e-3, 100),
        "rms angle between the poses of a further camera by single images and by all, for the worst one",
    ] = None


class Result(Record):
    """The registrations that the step was judged by, by source and resolution; the outlines at full size."""

    outlines_sha256: str
    registrations: dict[str, Registration]
    cameras: dict[str, FurtherCameraAnswer] = Field(default_factory=dict[str, FurtherCameraAnswer])  # further ones


def execute(context: StepContext, params: RegistrationParams) -> StepOutcome:
    """Detect the spheres, and register every source that the step waits for; the others are enqueued as well."""
    waited = decisive(context.protocol, context.step)
    search = search_for_spheres(context, params)
    root = arguments_name(search.arguments)
    later = [name for name in params.registrations if name not in waited]
    context.note(PLANNED, decisive=list(waited), later=later)
    seen = -1
    while True:
        context.checkpoint()
        state = context.evidence.state()
        if state.seq == seen:
            context.wait(0.2)
            continue
        seen = state.seq
        found = registration_jobs(state, context.step, waited, search, root)
        for name in waited:
            if name in found.failed:
                raise ComputeError(
                    f"no registration with {name} poses: {found.failed[name]}",
                    where=context.step.id,
                    remedy="Correct what the message names, or take the missing images; then try again",
                )
        context.progress(_words(found), len(found.arrived.keys() & set(waited)), len(waited))
        if all(name in found.arrived for name in waited):
            outcome = _outcome(found)
            _tell_findings(context, outcome)
            return _with_further_cameras(
                outcome,
                locate_further_cameras(context, params, search, found.arrived),
            )
        for task in found.due:
            context.evidence.enqueue(task.request, task.name)


def _words(found: RegistrationJobs) -> str:
    working = [task.request.kind for task in found.tasks if task.job and task.job.status == "enqueued"]
    return ", ".join(map(term, dict.fromkeys(working))) or "registration"


def _outcome(found: RegistrationJobs) -> StepOutcome:
    """Return the registrations so far, including any that arrived although the step did not wait for them."""
    done = [(task, task.job) for task in found.tasks if task.job is not None and task.job.status == "finished"]
    outlines = next(job for task, job in done if task.request.kind == DETECT_SPHERES.name)
    registrations = {name: OneRegistration.read(job.measures) for name, job in found.arrived.items()}
    measures = Measures.read(outlines.measures).model_copy(update={"registrations": registrations})
    result = Result(
        outlines_sha256=outlines.artefacts[0].sha256,
        registrations={name: REGISTER.read_answer(job.result) for name, job in found.arrived.items()},
    )
    artefacts = tuple(ref for _, job in done for ref in job.artefacts)
    sources = (ComputedBy(job=job.job, prefix=f"{name}_") for name, job in found.arrived.items())
    return StepOutcome(measures, artefacts, result, computed_by=(ComputedBy(job=outlines.job), *sources))


def _tell_findings(context: StepContext, outcome: StepOutcome) -> None:
    """Report what contradicts in the inputs, once for registrations that show the same."""
    assert isinstance(outcome.result, Result)
    shown: dict[str, list[str]] = {}
    for name, record in outcome.result.registrations.items():
        for one in record.findings:
            shown.setdefault(one.text, []).append(name)
    for text, names in shown.items():
        context.tell(f"{', '.join(names)}: {text}")


def _with_further_cameras(outcome: StepOutcome, located: Mapping[str, JobResult]) -> StepOutcome:
    """Return the outcome with the poses of the further cameras, and the measures of the worst of them."""
    if not located:
        return outcome
    measured = [job.measures for job in located.values()]
    off = {f"further_{name}": [m[name] for m in measured if name in m] for name in _CONSISTENCY}
    worst = {name: max(values) for name, values in off.items() if values}
    worst |= {
        "further_views": min(m["views"] for m in measured),
        "further_excluded": sum(m["excluded"] for m in measured),
    }
    cameras = {name: FURTHER_CAMERA.read_answer(job.result) for name, job in located.items()}
    assert isinstance(outcome.result, Result)
    return replace(
        outcome,
        measures=outcome.measures.model_copy(update=worst),
        artefacts=(*outcome.artefacts, *(ref for job in located.values() for ref in job.artefacts)),
        result=outcome.result.model_copy(update={"cameras": cameras}),
    )


KIND = StepKind(
    "registration",
    RegistrationParams,
    Measures,
    Result,
    execute,
)
