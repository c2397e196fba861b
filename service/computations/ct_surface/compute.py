"""Job `ct_surface`: the surface of a CT volume, and the spheres in it."""

from __future__ import annotations

from typing import Any

import numpy as np

from service.computations import ct_surface as ct_job
from service.computations.job import JobAnswer, JobContext
from service.computations.locate_spheres.compute import search_spheres
from service.compute.surfaces.constellations import match_constellations
from service.compute.surfaces.isosurface import (
    LEAST_CONTRAST_HU,
    cut_voxels,
    label_surface,
    sphere_contrasts,
    surface,
)
from service.compute.surfaces.mesh_spheres import locate_spheres as find_spheres
from service.core.errors import ComputeError
from service.core.geometry import Array
from service.core.units import mm
from service.machine.resources import large_arrays_returned


@large_arrays_returned()
def ct_surface(context: JobContext[ct_job.Arguments]) -> JobAnswer:
    """Compute the surface of a volume (Hounsfield units) at the threshold, and find the spheres in the CT frame.

    If the volume is segmented, the surface is that of the segments.
    """
    arguments = context.arguments
    hounsfield = np.load(context.input(arguments.hounsfield), allow_pickle=False, mmap_mode="r")
    T_ct_voxel = np.array(arguments.T_ct_voxel)
    if arguments.labels is None:
        vertices_m, faces = surface(hounsfield, T_ct_voxel, arguments.threshold_hu)
        ends = hounsfield[[0, -1]] >= arguments.threshold_hu
    else:
        labels = np.load(context.input(arguments.labels), allow_pickle=False, mmap_mode="r")
        vertices_m, faces = label_surface(labels, T_ct_voxel)
        ends = labels[[0, -1]] != 0
    file = context.scratch / "ct_surface.npz"
    np.savez(file, vertices_m=vertices_m, faces=faces)
    mesh = context.keep_file(file, kind="ct_mesh", media_type="application/x-npz")
    try:
        measures, found = search_spheres(arguments, vertices_m, faces)
    except ComputeError as error:
        if arguments.labels is not None:
            raise
        raise ComputeError(
            f"{error.what}. {_covered(T_ct_voxel, len(hounsfield))}",
            where="CT series",
            remedy="Compare the slices with the scanner's and send the whole series again if some are missing; "
            "otherwise check the threshold, and the number and radius of the spheres in the protocol",
        ) from error
    measures["surface_faces"] = float(len(faces))
    if arguments.measure_cut:
        voxel_mm2 = float(np.linalg.norm(np.cross(*mm(T_ct_voxel[:3, :2]).T)))
        measures["cut_by_ends_mm2"] = voxel_mm2 * cut_voxels(ends, T_ct_voxel, np.array(found.spheres_m))
    if arguments.labels is not None:
        measures["label_contrast_hu"] = _contrast(arguments, hounsfield, T_ct_voxel, np.array(found.spheres_m))
    return JobAnswer(measures, (mesh,), found)


def _covered(T_ct_voxel: Array, slices: int) -> str:
    """Say what slices cover along their normal: half a series without a gap looks whole."""
    normal = np.cross(T_ct_voxel[:3, 0], T_ct_voxel[:3, 1])
    normal /= np.linalg.norm(normal)
    first_m = float(normal @ T_ct_voxel[:3, 3])
    last_m = first_m + float(normal @ T_ct_voxel[:3, 2]) * (slices - 1)
    x, y, z = normal
    return (
        f"The {slices} slices cover {mm(first_m):.1f} to {mm(last_m):.1f} mm along their normal "
        f"({x:.2f}, {y:.2f}, {z:.2f}); if the spheres reach beyond, the series is incomplete"
    )


def _contrast(arguments: ct_job.Arguments, hounsfield: Any, T_ct_voxel: Array, centres: Array) -> float:
    """Return the least contrast, in HU, of the spheres (N, 3) of a segmentation in the volume that it segments.

    Raises ComputeError if there are none: the segmentation is mirrored, or of another series.
    """
    contrasts = sphere_contrasts(hounsfield, T_ct_voxel, centres, arguments.radius_m)
    least = float(contrasts.min())
    if least >= LEAST_CONTRAST_HU:
        return least
    count = int(np.count_nonzero(contrasts < LEAST_CONTRAST_HU))
    why = "it belongs to another series, or its voxels were moved"
    grey_m, triangles = surface(hounsfield, T_ct_voxel, arguments.threshold_hu)
    try:
        seen = find_spheres(grey_m, triangles, arguments.radius_m, arguments.expected)
        match_constellations(np.array([s.centre_m for s in seen]), centres)
    except ComputeError as error:
        if "mirror images" in error.what:
            why = "it is mirrored: an axis was negated when it was written"
    raise ComputeError(
        f"{count} of {len(centres)} segmented spheres are where the CT series has none ({least:.0f} HU denser than "
        f"their surroundings, {LEAST_CONTRAST_HU:.0f} HU are needed): {why}",
        where="segmentation of the CT series",
        remedy="Open series and segmentation together in another program, correct it, and import it again",
    )
