"""Step kind `scan_import`: stores and checks the export of the hand scanner, and finds the spheres."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Any, ClassVar

from pydantic import Field

from service.core.jobs.references import Reference
from service.core.protocol.step_params import NAMES_SPHERES, NamesStep, NeededDevice, RepeatedStep, StepParams
from service.core.records.events import ArtefactRef, Record
from service.core.units import metres
from service.jobs.records import Point, SphereDetails
from service.jobs.surfaces import locate_spheres, merge_scans
from service.steps.arrivals import keep_mesh, wait_for
from service.steps.context import Announcement, JobRequest, StepContext, StepKind, StepOutcome
from service.steps.inputs import earlier_answer, earlier_result
from service.steps.kinds.by_hand import timed_application
from service.steps.layouts import layout_uncertainties
from service.steps.measures import Count, ErrorMm, Measure, SphereMeasures

_NAMES_APPLICATION = NamesStep("applies a coat", lambda params: isinstance(params, timed_application.Params))


class Params(StepParams):
    """What the scan must contain."""

    gives: ClassVar = "scan_surface"
    repeated: ClassVar = RepeatedStep("Scan again, export the scan, and import it")

    spheres: int  # number of spheres in the scan
    parts: int = Field(default=1, ge=1)  # exports that together are the scan; each shares four spheres with another
    wait_s: float = 1800.0  # longest wait until the export is complete
    device: str | None = None  # name of the scanner in rig.yaml; None: the only one
    application: Annotated[str | None, _NAMES_APPLICATION] = None  # the step whose coat is still on the specimen
    # An earlier ct_import or scan_import, to see whether spheres moved since.
    compare_with: Annotated[str | None, NAMES_SPHERES] = None

    @property
    def needed_devices(self) -> tuple[NeededDevice, ...]:
        """A scanner."""
        return (NeededDevice("scanner", self.device),)


class Measures(SphereMeasures):
    """Of the mesh as it was exported, and of the spheres in it."""

    scan_vertices: Annotated[Count, "vertices of the scan"] = None
    scan_faces: Annotated[Count, "faces of the scan"] = None
    scan_holes: Annotated[Count, "closed loops of boundary edges"] = None
    scan_boundary_edges: Annotated[Count, "edges with one face"] = None
    scan_non_manifold_edges: Annotated[Count, "edges with more than two faces"] = None
    scan_components: Annotated[Count, "parts that are not connected"] = None
    scan_degenerate_faces: Annotated[Count, "faces without an area"] = None
    scan_unreferenced_vertices: Annotated[Count, "vertices of no face"] = None
    scan_normals_computed: Annotated[Count, "1 if the scan came without normals and they were computed, else 0"] = (
        None
    )
    scan_textures: Annotated[Count, "texture images that came with the scan"] = None
    scan_parts: Annotated[Count, "exports that were merged by their spheres"] = None
    part_spheres_shared: Annotated[Count, "spheres that two parts or more show"] = None
    part_residual_rms_mm: Annotated[
        ErrorMm, "rms distance of a shared sphere in a part from its mean over the parts, after merging"
    ] = None
    part_residual_max_mm: Annotated[ErrorMm, "largest distance of that kind"] = None
    faces: Annotated[Count, "faces of the mesh that is used"] = None
    since_application_min: Annotated[
        float | None, Measure("min", 0.1, 1e4), "time from the application of the coat to the arrival of the scan"
    ] = None


class Result(Record):
    """The spheres in the scan frame, metres."""

    spheres_m: tuple[Point, ...]
    details: SphereDetails


def execute(context: StepContext, params: Params) -> StepOutcome:
    """Wait for a complete export since the previous step, store it, and let the worker find the spheres."""
    scanner = context.devices.scanner(params.device)
    # The technician exports, then confirms: exports since the end of the previous step belong to this one. In an
    # import, the files existed before.
    importing = context.devices.imported() is not None
    since = "" if importing else max((step.ended_utc for step in context.run.steps.values()), default="")

    def fresh() -> list[Any]:
        found = [e for e in scanner.exports() if not since or _time(e.modified_utc) >= _time(since)]
        return [found[-params.parts :]] if len(found) >= params.parts else []

    wanted = "a complete scan export" if params.parts == 1 else f"{params.parts} complete scan exports"
    scans = [scanner.read(export) for export in wait_for(context, fresh, params.wait_s, wanted, scanner.report)]
    found = {f"scan_{name}": sum(float(scan.findings[name]) for scan in scans) for name in scans[0].findings}
    measures = {name: value for name, value in found.items() if name in Measures.declared()}  # a driver may find more
    measures["faces"] = float(sum(len(scan.mesh.faces) for scan in scans))
    if params.application is not None:
        applied_s = earlier_result(context, params.application, timed_application.Result).applied_monotonic_s
        measures["since_application_min"] = (context.monotonic_s() - applied_s) / 60
    kind = "scan_mesh" if params.parts == 1 else "scan_part"
    pairs = [keep_mesh(context, scan, device="scanner", kind=kind) for scan in scans]
    kept = tuple(ref for _, refs in pairs for ref in refs)
    request = _request(context, params, [mesh for mesh, _ in pairs])
    (answer,) = context.evidence.run_jobs(request)
    if params.parts > 1:
        merged = merge_scans.KIND.read_answer(answer.result)
        context.note("parts merged", T_mesh_part=merged.T_mesh_part)
        result = Result(spheres_m=merged.spheres_m, details=merged.details)
    else:
        result = Result.model_validate(answer.result)
    uncertainties = layout_uncertainties(result.details.layout)
    return StepOutcome(
        Measures.read({**measures, **answer.measures}),
        kept + answer.artefacts,
        result,
        uncertainties,
        (answer.source,),
    )


def _request(context: StepContext, params: Params, meshes: list[ArtefactRef]) -> JobRequest:
    """The search in the only mesh, or the merging of several and the search in what results."""
    arguments, references = _arguments(context, params, meshes[0])
    if len(meshes) == 1:
        return JobRequest.of(locate_spheres.KIND, arguments, references)
    merging = merge_scans.Arguments(
        meshes=tuple(mesh.sha256 for mesh in meshes),
        radius_m=arguments.radius_m,
        expected=arguments.expected,
        reference_m=arguments.reference_m,
        reference_covariances_m2=arguments.reference_covariances_m2,
    )
    return JobRequest.of(merge_scans.KIND, merging, references)


def _arguments(
    context: StepContext, params: Params, mesh: ArtefactRef
) -> tuple[locate_spheres.Arguments, dict[str, Reference | None]]:
    """The arguments of the search, with the spheres to compare with, and the references to these."""
    arguments = locate_spheres.Arguments(
        mesh=mesh.sha256, radius_m=metres(context.protocol.spheres.radius_mm), expected=params.spheres
    )
    if params.compare_with is None or params.compare_with in context.run.skipped:
        return arguments, {}
    earlier = earlier_answer(context, params.compare_with, locate_spheres.KIND)
    compared = {
        "reference_m": earlier.answer.spheres_m,
        "reference_covariances_m2": tuple(sphere.covariance_m2 for sphere in earlier.answer.details.spheres),
    }
    references = {
        "reference_m": earlier.reference("spheres_m"),
        "reference_covariances_m2": earlier.reference("details/spheres/*/covariance_m2"),
    }
    return arguments.model_copy(update=compared), references


def _time(text: str) -> datetime:
    moment = datetime.fromisoformat(text)
    return moment if moment.tzinfo else moment.replace(tzinfo=UTC)


KIND = StepKind(
    "scan_import",
    Params,
    Measures,
    Result,
    execute,
    words=lambda _params, _before: Announcement(
        "import the scan", "Nothing moves. The software waits for the export."
    ),
    drawing="scan_path",
)
