"""Job `locate_spheres`: the spheres of a mesh, and how they moved since an earlier measurement."""

from __future__ import annotations

from typing import Any

import numpy as np

from service.computations import ct_surface as ct_job
from service.computations import locate_spheres as locate_job
from service.computations.conversion import judged_layout, measured_sphere
from service.computations.job import JobAnswer, JobContext
from service.computations.records import LoopClosure as LoopClosureRecord
from service.computations.records import SphereChange, SphereDetails, SpheresFound, matrix
from service.compute.layout.ambiguity import SUBSET as LAYOUT_SUBSET
from service.compute.layout.ambiguity import check_layout, layout_measures
from service.compute.surfaces.constellations import LoopClosure, close_loop, match_constellations
from service.compute.surfaces.mesh_spheres import MeshSphere, wrong_unit
from service.compute.surfaces.mesh_spheres import locate_spheres as find_spheres
from service.core.errors import ComputeError
from service.core.geometry import Array
from service.core.units import mm
from service.machine.resources import large_arrays_returned


@large_arrays_returned()
def locate_spheres(context: JobContext[locate_job.Arguments]) -> JobAnswer:
    """Find the spheres of a mesh; with `reference_m`, also how they moved since an earlier measurement."""
    with np.load(context.input(context.arguments.mesh), allow_pickle=False) as mesh:
        measures, found = search_spheres(context.arguments, mesh["vertices_m"], mesh["faces"])
    return JobAnswer(measures, (), found)


def search_spheres(
    arguments: ct_job.Arguments | locate_job.Arguments, vertices_m: Array, faces: Any
) -> tuple[dict[str, float], SpheresFound]:
    """Return the measures and the spheres of a mesh."""
    radius_m = arguments.radius_m
    spheres = found_spheres(vertices_m, faces, radius_m, arguments.expected)
    centres = np.array([s.centre_m for s in spheres])
    covariances = np.array([s.covariance for s in spheres])
    layout = check_layout(centres, covariances, radius_m=radius_m) if len(spheres) >= LAYOUT_SUBSET else None
    weights = np.array([s.radius_sigma_m for s in spheres]) ** -2.0
    residual_m = float(np.average([s.radius_residual_m for s in spheres], weights=weights))
    measures = {
        "spheres_found": float(len(spheres)),
        "sphere_radius_mm": mm(radius_m + residual_m),
        "radius_residual_max_mm": mm(max(abs(s.radius_residual_m) for s in spheres)),
        "sphere_rms_max_mm": mm(max(s.rms_m for s in spheres)),
        "sphere_sigma_max_mm": mm(max(float(np.sqrt(np.trace(s.covariance))) for s in spheres)),
    }
    details = SphereDetails(spheres=tuple(measured_sphere(s) for s in spheres))
    if layout is not None:
        measures |= layout_measures(layout)
        details = details.model_copy(update={"layout": judged_layout(layout)})
    if isinstance(arguments, locate_job.Arguments) and arguments.reference_m is not None:
        reference = np.array(arguments.reference_m)
        match = match_constellations(reference, centres)
        measures["spheres_compared"] = float(len(match.pairs))
        measures["sphere_change_rms_mm"] = mm(match.rms_m)
        measures["sphere_change_max_mm"] = mm(float(match.residuals_m.max()))
        details = details.model_copy(update={"T_reference_mesh": matrix(match.T_a_b)})
        if arguments.reference_covariances_m2 is not None:
            closure = close_loop(reference, np.array(arguments.reference_covariances_m2), centres, covariances, match)
            measures["spheres_moved"] = float(len(closure.moved))
            measures["loop_closure_chi2"] = closure.chi2_per_dof
            measures["sphere_scale_percent"] = 100 * (closure.scale - 1)
            measures["sphere_scale_sigma_percent"] = 100 * closure.scale_sigma
            details = details.model_copy(update={"loop_closure": _closure_record(closure)})
    return measures, SpheresFound(spheres_m=centres.tolist(), details=details)


def found_spheres(
    vertices_m: Array, faces: Any, radius_m: float, expected: int | None = None
) -> tuple[MeshSphere, ...]:
    """Return the spheres, of any number or `expected`; an error says so if they are missing because of the unit."""
    try:
        return find_spheres(vertices_m, faces, radius_m, expected)
    except ComputeError as error:
        mistake = wrong_unit(vertices_m, faces, radius_m)
        if mistake is None:
            raise
        raise ComputeError(
            f"the mesh was read in the wrong unit: with its coordinates multiplied by {mistake.factor:g} it has "
            f"{mistake.spheres} spheres of {mm(radius_m):g} mm radius, as it is it lacks some ({mistake.words})",
            remedy="Set the unit in the program that exported it, or in rig.yaml, and import it again; "
            "nothing is scaled silently",
        ) from error


def _closure_record(closure: LoopClosure) -> LoopClosureRecord:
    return LoopClosureRecord(
        T_reference_mesh=matrix(closure.T_a_b),
        chi2_per_dof=closure.chi2_per_dof,
        rms_mm=mm(closure.rms_m),
        sigma_rms_mm=mm(closure.sigma_rms_m),
        spheres=tuple(
            SphereChange(
                reference=s.pair[0],
                sphere=s.pair[1],
                difference_mm=mm(s.difference_m).tolist(),
                sigma_mm=mm(s.sigma_m),
                z=s.z,
                moved=s.moved,
            )
            for s in closure.spheres
        ),
    )
