"""Jobs of scans and CT: the surface of a CT, the spheres in a mesh, and one scan of several partial ones."""

from __future__ import annotations

from typing import Any

import numpy as np

from service.computations.conversion import judged_layout, measured_sphere
from service.computations.job import JobAnswer, JobContext
from service.computations.records import LoopClosure as LoopClosureRecord
from service.computations.records import SphereChange, SphereDetails, SpheresFound, matrix
from service.computations.scans import (
    CtSurfaceArguments,
    LocateSpheresArguments,
    MergeScansAnswer,
    MergeScansArguments,
)
from service.compute.layout.ambiguity import SUBSET as LAYOUT_SUBSET
from service.compute.layout.ambiguity import check_layout, layout_measures
from service.compute.surfaces.constellations import LoopClosure, close_loop, match_constellations, merge_parts
from service.compute.surfaces.isosurface import (
    LEAST_CONTRAST_HU,
    cut_voxels,
    label_surface,
    sphere_contrasts,
    surface,
)
from service.compute.surfaces.mesh_spheres import MeshSphere, wrong_unit
from service.compute.surfaces.mesh_spheres import locate_spheres as find_spheres
from service.core.errors import ComputeError
from service.core.geometry import Array, apply
from service.core.units import mm
from service.machine.resources import large_arrays_returned


@large_arrays_returned()
def ct_surface(context: JobContext[CtSurfaceArguments]) -> JobAnswer:
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


def _contrast(arguments: CtSurfaceArguments, hounsfield: Any, T_ct_voxel: Array, centres: Array) -> float:
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


@large_arrays_returned()
def locate_spheres(context: JobContext[LocateSpheresArguments]) -> JobAnswer:
    """Find the spheres of a mesh; with `reference_m`, also how they moved since an earlier measurement."""
    with np.load(context.input(context.arguments.mesh), allow_pickle=False) as mesh:
        measures, found = search_spheres(context.arguments, mesh["vertices_m"], mesh["faces"])
    return JobAnswer(measures, (), found)


def search_spheres(
    arguments: CtSurfaceArguments | LocateSpheresArguments, vertices_m: Array, faces: Any
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
    if isinstance(arguments, LocateSpheresArguments) and arguments.reference_m is not None:
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


@large_arrays_returned()
def merge_scans(context: JobContext[MergeScansArguments]) -> JobAnswer:
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
    located = LocateSpheresArguments(
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
    answer = MergeScansAnswer(
        spheres_m=spheres.spheres_m,
        details=spheres.details,
        T_mesh_part=tuple(matrix(T) for T in merged.T_first_part),
    )
    return JobAnswer(measures, (mesh,), answer)
