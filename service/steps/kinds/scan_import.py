"""Step kind `scan_import`: the hand scanner's export is kept, checked and searched for its spheres."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from service.core.jobs.references import Reference
from service.core.records.events import Record
from service.core.units import metres
from service.jobs.surfaces import locate_spheres
from service.steps.arrivals import keep_mesh, wait_for
from service.steps.context import Announcement, JobRequest, StepContext, StepKind, StepOutcome
from service.steps.inputs import result_of, taken
from service.steps.layouts import layout_uncertainties
from service.steps.measured import COUNT, SCAN, SPHERES, Measure


class Params(Record):
    """What the scan must hold."""

    spheres: int  # that the scan must hold
    wait_s: float = 1800.0  # for the export to appear and be complete
    device: str | None = None  # name of the scanner in rig.yaml; None: the only one
    application: str | None = None  # the step whose coat is still on the specimen
    compare_with: str | None = None  # an earlier ct_import or scan_import: did the spheres move since?


class Result(Record):
    """The spheres in the scan frame, metres."""

    spheres_m: tuple[tuple[float, float, float], ...]
    details: dict[str, Any]


def execute(context: StepContext, params: Params) -> StepOutcome:
    """Wait for a complete export that is newer than the step before, keep it, let the worker find the spheres."""
    scanner = context.devices.scanner(params.device)
    # The technician exports, then confirms: what arrived since the step before this one ended belongs to it. What is
    # imported was there before.
    importing = context.devices.imported() is not None
    since = "" if importing else max((step.ended_utc for step in context.run.steps.values()), default="")

    def fresh() -> list[Any]:
        return [e for e in scanner.exports() if not since or _time(e.modified_utc) >= _time(since)]

    scan = scanner.read(wait_for(context, fresh, params.wait_s, "a complete scan export"))
    measures = {f"scan_{name}": float(value) for name, value in scan.findings.items()}
    measures["faces"] = float(len(scan.mesh.faces))
    if params.application is not None:
        applied = float(result_of(context, params.application)["applied_monotonic_s"])
        measures["since_application_min"] = (context.monotonic_s() - applied) / 60
    mesh, kept = keep_mesh(context, scan, device="scanner", kind="scan_mesh")
    arguments = locate_spheres.Arguments(
        mesh=mesh.sha256, radius_m=metres(context.protocol.spheres.radius_mm), expected=params.spheres
    )
    references: dict[str, Reference | None] = {}
    if params.compare_with is not None and params.compare_with not in context.run.skipped:
        reference = taken(context, params.compare_with, locate_spheres.KIND)
        compared = {
            "reference_m": reference.answer.spheres_m,
            "reference_covariances_m2": tuple(s.covariance_m2 for s in reference.answer.details.spheres),
        }
        arguments = arguments.model_copy(update=compared)
        references = {
            "reference_m": reference.reference("spheres_m"),
            "reference_covariances_m2": reference.reference("details/spheres/*/covariance_m2"),
        }
    (answer,) = context.evidence.run_jobs(JobRequest.of(locate_spheres.KIND, arguments, references))
    result = Result.model_validate(answer.result)
    uncertainties = layout_uncertainties(result.details["layout"]) if "layout" in result.details else {}
    return StepOutcome(
        {**measures, **answer.measures}, kept + answer.artefacts, result.model_dump(mode="json"), uncertainties
    )


def _time(text: str) -> datetime:
    moment = datetime.fromisoformat(text)
    return moment if moment.tzinfo else moment.replace(tzinfo=UTC)


KIND = StepKind(
    "scan_import",
    Params,
    Result,
    execute,
    measures={**SPHERES, **SCAN, "faces": COUNT, "since_application_min": Measure("min", 0.1, 1e4)},
    words=lambda _params, _before: Announcement(
        "import the scan", "Nothing moves. The software waits for the export."
    ),
    drawing="scan_path",
)
