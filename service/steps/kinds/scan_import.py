"""Step kind `scan_import`: stores and checks the export of the hand scanner, and finds the spheres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Annotated, Any, ClassVar

from pydantic import Field

from drivers.interfaces import ScanExport
from service.computations.records import Point, SphereDetails
from service.computations.scans import LOCATE_SPHERES, MERGE_SCANS, LocateSpheresArguments, MergeScansArguments
from service.core.jobs import Reference
from service.core.records.base import ArtefactRef, Record, elapsed
from service.core.step_params import NAMES_SPHERES, NamesStep, NeededDevice, RepeatedStep, StepParams
from service.core.units import metres
from service.core.words import counted
from service.steps.arrivals import keep_mesh, layout_uncertainties, wait_for
from service.steps.context import Announcement, JobRequest, StepContext, StepKind, StepOutcome
from service.steps.kinds import timed_application
from service.steps.measures import Count, ErrorMm, Measure, SphereMeasures

AGE = "since_application_min"  # the measure of how old the coat was
_NAMED = 20  # exports in a record of what was left out, the newest
_NAMES_APPLICATION = NamesStep("applies a coat", lambda params: isinstance(params, timed_application.Params))


class Params(StepParams):
    """The contents that the scan must have, and where it comes from."""

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
    """The measures of the mesh as it was exported, and of the spheres in it."""

    scan_vertices: Annotated[Count, "vertices of the scan"] = None
    scan_faces: Annotated[Count, "faces of the scan"] = None
    scan_holes: Annotated[Count, "closed loops of boundary edges"] = None
    scan_boundary_edges: Annotated[Count, "edges with one face"] = None
    scan_non_manifold_edges: Annotated[Count, "edges with more than two faces"] = None
    scan_components: Annotated[Count, "parts that are not connected"] = None
    scan_degenerate_faces: Annotated[Count, "faces without an area"] = None
    scan_unreferenced_vertices: Annotated[Count, "vertices of no face"] = None
    scan_polygons_in_doubt: Annotated[
        Count, "polygons of the scan with fewer than three corners, no area, or an outline that crosses itself"
    ] = None
    scan_normals_computed: Annotated[Count, "1 if the scan came without normals and they were computed, else 0"] = (
        None
    )
    scan_textures: Annotated[Count, "texture images that came with the scan"] = None
    scan_parts: Annotated[Count, "exports that were merged by their spheres"] = None
    part_spheres_shared: Annotated[Count, "spheres that two parts or more show"] = None
    part_residual_rms_mm: Annotated[
        ErrorMm, "rms distance of a shared sphere in a part from its mean over the parts, after merging"
    ] = None
    part_residual_max_mm: Annotated[
        ErrorMm, "largest distance of a shared sphere in a part from its mean over the parts, after merging"
    ] = None
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

    left_out = _LeftOut(context, since)

    def fresh() -> list[Any]:
        exports = scanner.exports()
        found = [e for e in exports if not since or _time(e.modified_utc) >= _time(since)]
        if len(found) >= params.parts:
            return [found[-params.parts :]]
        left_out.look([e for e in exports if e not in found])
        return []

    wanted = "a complete scan export" if params.parts == 1 else f"{params.parts} complete scan exports"
    scans = [scanner.read(export) for export in wait_for(context, fresh, params.wait_s, wanted, scanner.report)]
    found = {f"scan_{name}": sum(float(scan.findings[name]) for scan in scans) for name in scans[0].findings}
    measures = {name: value for name, value in found.items() if name in Measures.declared()}  # a driver may find more
    measures["faces"] = float(sum(len(scan.mesh.faces) for scan in scans))
    if params.application is not None:
        measures |= _age(context, params.application)
    kind = "scan_mesh" if params.parts == 1 else "scan_part"
    pairs = [keep_mesh(context, scan, device="scanner", kind=kind) for scan in scans]
    kept = tuple(ref for _, refs in pairs for ref in refs)
    request = _request(context, params, [mesh for mesh, _ in pairs])
    (answer,) = context.evidence.run_jobs(request)
    if params.parts > 1:
        merged = MERGE_SCANS.read_answer(answer.result)
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


class _LeftOut:
    """Exports that are older than the step before: named to the operator and recorded, in case one is the new one."""

    def __init__(self, context: StepContext, since: str) -> None:
        self._context, self._since = context, since
        self._told: set[tuple[str, str]] = set()
        kept = (ref for step in context.run.steps.values() for ref in step.artefacts)
        self._imported = {(ref.original_name, ref.size_bytes) for ref in kept}

    def look(self, exports: Sequence[ScanExport]) -> None:
        """Report exports that were not reported yet; a host whose clock was set back dates new ones before.

        Those that an earlier step of this run imported are where they belong.
        """
        new = [
            export
            for export in exports
            if (export.name, export.modified_utc) not in self._told and not self._is_imported(export)
        ]
        if not new:
            return
        self._told.update((export.name, export.modified_utc) for export in new)
        newest = max(new, key=lambda export: _time(export.modified_utc))
        text = (
            f"left out {counted(len(new), 'export')} older than the end of the step before ({self._since}); the "
            f"newest is {newest.name}, written {newest.modified_utc}. If it is the new scan, the clock was set back: "
            "export it again once the computer's clock is right and past that time"
        )
        self._context.tell(text)
        shown = sorted(new, key=lambda export: _time(export.modified_utc))[-_NAMED:]
        self._context.note(text, left_out={export.name: export.modified_utc for export in shown}, since=self._since)

    def _is_imported(self, export: ScanExport) -> bool:
        mesh = export.files[0]
        return mesh.exists() and (mesh.name, mesh.stat().st_size) in self._imported


def _age(context: StepContext, application: str) -> dict[str, float]:
    """Return the time since a coat was applied; nothing, with the reason, if it is unknown. Both clocks are noted."""
    applied = context.earlier_result(application, timed_application.Result).applied
    arrived = context.moment()
    age = elapsed(applied, arrived)
    clocks = {"applied": asdict(applied), "arrived": asdict(arrived)}
    if age.seconds is None:
        text = f"the time since the coat was applied is not known: {age.why}"
        context.tell(text)
        context.note(text, **clocks)
        return {}
    context.note(f"the scan arrived {age.seconds / 60:.1f} min after the coat was applied", **clocks)
    return {AGE: age.seconds / 60}


def _request(context: StepContext, params: Params, meshes: list[ArtefactRef]) -> JobRequest:
    """Return the search in the only mesh, or the merging of several and the search in what results."""
    arguments, references = _arguments(context, params, meshes[0])
    if len(meshes) == 1:
        return JobRequest.of(LOCATE_SPHERES, arguments, references)
    merging = MergeScansArguments(
        meshes=tuple(mesh.sha256 for mesh in meshes),
        radius_m=arguments.radius_m,
        expected=arguments.expected,
        reference_m=arguments.reference_m,
        reference_covariances_m2=arguments.reference_covariances_m2,
    )
    return JobRequest.of(MERGE_SCANS, merging, references)


def _arguments(
    context: StepContext, params: Params, mesh: ArtefactRef
) -> tuple[LocateSpheresArguments, dict[str, Reference | None]]:
    """Return the arguments of the search, with the spheres to compare with, and the references to these."""
    arguments = LocateSpheresArguments(
        mesh=mesh.sha256, radius_m=metres(context.protocol.spheres.radius_mm), expected=params.spheres
    )
    if params.compare_with is None or params.compare_with in context.run.skipped:
        return arguments, {}
    earlier = context.earlier_answer(params.compare_with, LOCATE_SPHERES)
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
