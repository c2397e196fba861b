"""Jobs on surfaces: the CT volume becomes a mesh, and every mesh is searched for its spheres."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from service.compute.surfaces.constellations import match_constellations
from service.compute.surfaces.isosurface import surface
from service.compute.surfaces.mesh_spheres import MeshSphere
from service.compute.surfaces.mesh_spheres import locate_spheres as find_spheres
from service.core.geometry import Array
from service.worker.job import JobAnswer, JobContext


def ct_surface(context: JobContext) -> JobAnswer:
    """Hounsfield volume → surface at the threshold → spheres in the CT frame."""
    arguments = context.arguments
    hounsfield = np.load(context.input(arguments["hounsfield"]), allow_pickle=False, mmap_mode="r")
    vertices_m, faces = surface(hounsfield, np.array(arguments["T_ct_voxel"]), float(arguments["threshold_hu"]))
    buffer = io.BytesIO()
    np.savez(buffer, vertices_m=vertices_m, faces=faces)
    mesh = context.keep_bytes(
        buffer.getvalue(), kind="ct_mesh", media_type="application/x-npz", name="ct_surface.npz"
    )
    answer = _search(context, vertices_m, faces)
    return JobAnswer({**answer.measures, "surface_faces": float(len(faces))}, (mesh,), answer.result)


def locate_spheres(context: JobContext) -> JobAnswer:
    """Spheres of a decoded mesh; with `reference_m`, how they moved against an earlier measurement."""
    with np.load(context.input(context.arguments["mesh"]), allow_pickle=False) as mesh:
        return _search(context, mesh["vertices_m"], mesh["faces"])


def _search(context: JobContext, vertices_m: Array, faces: Any) -> JobAnswer:
    arguments = context.arguments
    spheres = find_spheres(vertices_m, faces, float(arguments["radius_m"]), int(arguments["expected"]))
    measures = {
        "spheres_found": float(len(spheres)),
        "radius_residual_max_mm": 1e3 * max(abs(s.radius_residual_m) for s in spheres),
        "sphere_rms_max_mm": 1e3 * max(s.rms_m for s in spheres),
        "sphere_sigma_max_mm": 1e3 * max(float(np.sqrt(np.trace(s.covariance))) for s in spheres),
    }
    centres = np.array([s.centre_m for s in spheres])
    details: dict[str, Any] = {"spheres": [_record(s) for s in spheres]}
    if arguments.get("reference_m") is not None:
        match = match_constellations(np.array(arguments["reference_m"]), centres)
        measures["spheres_compared"] = float(len(match.pairs))
        measures["sphere_change_rms_mm"] = 1e3 * match.rms_m
        measures["sphere_change_max_mm"] = 1e3 * float(match.residuals_m.max())
        details["T_reference_mesh"] = match.T_a_b.tolist()
    return JobAnswer(measures, (), {"spheres_m": centres.tolist(), "details": details})


def _record(sphere: MeshSphere) -> dict[str, Any]:
    return {
        "centre_m": sphere.centre_m.tolist(),
        "covariance_m2": sphere.covariance.tolist(),
        "rms_mm": 1e3 * sphere.rms_m,
        "radius_residual_mm": 1e3 * sphere.radius_residual_m,
        "coverage": sphere.coverage,
        "vertices": sphere.n,
    }
