"""Job `coverage_points`: points of the specimen's surface that the images should see."""

from __future__ import annotations

import io

import numpy as np

from service.computations import coverage_points as coverage_job
from service.computations.job import JobAnswer, JobContext
from service.computations.scene import limits_of
from service.compute.planning.coverage import coverage_surface
from service.machine.resources import large_arrays_returned


@large_arrays_returned()
def coverage_points(context: JobContext[coverage_job.Arguments]) -> JobAnswer:
    """Sample the surface of the CT outside the spheres."""
    arguments = context.arguments
    spheres, radius_m = np.array(arguments.spheres_m), arguments.radius_m
    with np.load(context.input(arguments.mesh), allow_pickle=False) as mesh:
        surface = coverage_surface(mesh["vertices_m"], mesh["faces"], spheres, radius_m, limits_of(arguments.limits))
    buffer = io.BytesIO()
    np.savez(
        buffer,
        points_m=surface.points_m,
        normals=surface.normals,
        occluder_vertices_m=surface.occluder_vertices_m,
        occluder_faces=surface.occluder_faces,
    )
    ref = context.keep_bytes(
        buffer.getvalue(), kind="coverage_points", media_type="application/x-npz", name="coverage_points.npz"
    )
    return JobAnswer({"coverage_points": float(len(surface.points_m))}, (ref,))
