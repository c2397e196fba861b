"""Job `merge_scans`: one mesh of the parts of a scan, which are joined by their spheres."""

from __future__ import annotations

import numpy as np

from service.computations import locate_spheres as locate_job
from service.computations import merge_scans as merge_job
from service.computations.job import JobAnswer, JobContext
from service.computations.locate_spheres.compute import found_spheres, search_spheres
from service.computations.records import matrix
from service.compute.surfaces.constellations import merge_parts
from service.core.errors import ComputeError
from service.core.geometry import apply
from service.core.units import mm
from service.machine.resources import large_arrays_returned


@large_arrays_returned()
def merge_scans(context: JobContext[merge_job.Arguments]) -> JobAnswer:
    """Put the parts into the frame of the first by their spheres; their surfaces lie over each other, unchanged."""
    arguments = context.arguments
    parts = []
    for sha256 in arguments.meshes:
        with np.load(context.input(sha256), allow_pickle=False) as mesh:
            parts.append((mesh["vertices_m"], mesh["faces"]))
    centres = []
    for number, (vertices_m, faces) in enumerate(parts, start=1):
        try:
            found = found_spheres(vertices_m, faces, arguments.radius_m)
        except ComputeError as error:
            raise ComputeError(f"part {number} of the scan: {error.what}", remedy=error.remedy) from error
        centres.append(np.array([sphere.centre_m for sphere in found]).reshape(-1, 3))
    merged = merge_parts(centres)
    vertices = np.concatenate([apply(T, own) for T, (own, _) in zip(merged.T_first_part, parts, strict=True)])
    first = np.cumsum([0, *(len(own) for own, _ in parts[:-1])])
    faces = np.concatenate([own + start for start, (_, own) in zip(first, parts, strict=True)])
    file = context.scratch / "merged.npz"
    np.savez(file, vertices_m=vertices, faces=faces)
    mesh = context.keep_file(file, kind="scan_mesh", media_type="application/x-npz")
    located = locate_job.Arguments(
        mesh=mesh.sha256,
        radius_m=arguments.radius_m,
        expected=arguments.expected,
        reference_m=arguments.reference_m,
        reference_covariances_m2=arguments.reference_covariances_m2,
    )
    measures, spheres = search_spheres(located, vertices, faces)
    measures |= {
        "scan_parts": float(len(parts)),
        "part_spheres_shared": float(merged.shared),
        "part_residual_rms_mm": mm(merged.rms_m),
        "part_residual_max_mm": mm(float(merged.residuals_m.max())),
    }
    answer = merge_job.Answer(
        spheres_m=spheres.spheres_m,
        details=spheres.details,
        T_mesh_part=tuple(matrix(T) for T in merged.T_first_part),
    )
    return JobAnswer(measures, (mesh,), answer)
