"""Job `fuse`: the ground-truth mesh from the CT and the scan, and the checks that both are in one frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from service.compute.ground_truth.align import (
    Aligned,
    MeshSpheres,
    TransformLoop,
    align_spheres,
    close_transforms,
    common_part,
)
from service.compute.ground_truth.chamfer import ChamferScore, ChamferSettings, chamfer
from service.compute.ground_truth.fuse import Fused, FusionSettings, Markers, Source, without_markers
from service.compute.ground_truth.fuse import fuse as fuse_surfaces
from service.compute.ground_truth.heat_map import HeatScale, fusion_picture, write_heat_mesh
from service.compute.ground_truth.overlap import Box, Prism, RegionCorrection, outline, seen_along
from service.compute.ground_truth.surface import Surface, write_ply
from service.core.errors import DataError
from service.core.geometry import Array, Transform, apply, inverse
from service.core.records.events import ArtefactRef
from service.core.units import deg, metres, mm
from service.dataset.records import SIMULATED
from service.jobs import fuse as job
from service.jobs.records import Point, SpheresFound, matrix
from service.machine.resources import large_arrays_returned
from service.worker.job import JobAnswer, JobContext

_MM = 1e-3  # metres in the unit of the files
_COMMENTS = ("in the frame of the scan, mm", "source 0: CT, 1: scan, 2: blend; sigma along the normal")


@large_arrays_returned()
def fuse(context: JobContext[job.Arguments]) -> JobAnswer:
    """Bring the CT into the frame of the scan, compare both, and fuse them."""
    arguments = context.arguments
    context.progress("spheres", 0, 4)
    aligned = align_spheres(_spheres(arguments.ct), _spheres(arguments.scan))
    scan = Surface.kept(context.input(arguments.scan_mesh))
    up = scan.area_vectors_m2.sum(axis=0)  # a scan sees its scene from above only: its faces together point up
    frames = _frames(arguments, aligned)
    corrections = tuple(_correction(region, frames, up) for region in arguments.regions)
    context.progress("distances", 1, 4)
    # The whole CT is named nowhere: most of its faces may be noise, and are freed as soon as they are left out.
    common = common_part(
        Surface.kept(context.input(arguments.ct_mesh)).moved(aligned.T_scan_ct), aligned, arguments.radius_m
    )
    score = chamfer(common.ct, scan, ChamferSettings(arguments.spacing_m, to_faces=False, of_vertices=True))
    context.progress("fusion", 2, 4)
    fused = fuse_surfaces(common.ct, scan, up, _settings(arguments, aligned), corrections, common.taken)
    wound_m = _wound(fused, up)
    if arguments.post_radius_m is not None:
        markers = Markers(aligned.scan_spheres_m, arguments.radius_m, up, arguments.post_radius_m)
        fused = without_markers(fused, markers)
    context.progress("pictures", 3, 4)
    loop = _loop(arguments, aligned)
    answer = job.Answer(
        T_scan_ct=matrix(aligned.T_scan_ct),
        covariance=matrix(aligned.covariance),
        T_scan_ct_by_images=None if loop is None else matrix(loop.T_scan_scan @ aligned.T_scan_ct),
        wound_m=wound_m,
        regions=arguments.regions,
        taken_away=aligned.only_ct,
    )
    files = _files(context, _ComparedSurfaces(common.ct, scan, score), fused)
    return JobAnswer(_measures(aligned, loop, score, fused), files, answer)


def _spheres(found: SpheresFound) -> MeshSpheres:
    details = found.details.spheres
    return MeshSpheres(
        np.array(found.spheres_m),
        np.array([sphere.covariance_m2 for sphere in details]),
        metres(np.array([sphere.rms_mm for sphere in details])),
    )


def _settings(arguments: job.Arguments, aligned: Aligned) -> FusionSettings:
    return FusionSettings(
        blend_m=arguments.blend_m,
        sigma_ct_m=aligned.sigma_ct_m,
        sigma_scan_m=aligned.sigma_scan_m,
        alignment_covariance=aligned.covariance,
        least_part_m2=0.0,  # small parts are left out already
    )


def _frames(arguments: job.Arguments, aligned: Aligned) -> dict[str, Transform]:
    """Return T_scan_frame by frame; without a registration there is no world."""
    frames = {"scan": np.eye(4), "ct": aligned.T_scan_ct}
    if arguments.scan_registration is not None:
        frames["world"] = inverse(np.array(arguments.scan_registration.T_world_scan))
    return frames


def _correction(region: job.Region, frames: dict[str, Transform], up: Array) -> RegionCorrection:
    T = frames.get(region.frame)
    if T is None:
        raise DataError(
            f"a region of the wound is in the frame {region.frame}, which this run does not know",
            remedy="Register the images first, or give the region in the frame of the scan",
        )
    return RegionCorrection(_space(region, T, up), from_ct=region.source == "ct", by=region.by)


def _space(region: job.Region, T_scan_frame: Transform, up: Array) -> Box | Prism:
    if region.centre_m is not None and region.size_m is not None:
        T_frame_box = np.eye(4)
        T_frame_box[:3, 3] = region.centre_m
        return Box(T_scan_frame @ T_frame_box, np.array(region.size_m))
    along = up if region.along is None else T_scan_frame[:3, :3] @ np.array(region.along)
    corners = apply(T_scan_frame, np.array(region.corners_m).reshape(-1, 3))
    return seen_along(corners, along, (-region.below_m, region.above_m))


def _wound(fused: Fused, up: Array) -> tuple[Point, ...]:
    """Return the corners of the wound's outline at its upper end; empty without a wound."""
    points = fused.surface.vertices_m[fused.wound]
    if len(points) < 3:
        return ()
    prism = outline(points, up)
    flat = np.column_stack([prism.polygon_m, np.full(len(prism.polygon_m), prism.depth_m[1])])
    return tuple((float(x), float(y), float(z)) for x, y, z in apply(prism.T_world_plane, flat))


def _loop(arguments: job.Arguments, aligned: Aligned) -> TransformLoop | None:
    """Close the loop: there by the spheres and back by the cameras; None without images."""
    of_ct, of_scan = arguments.ct_registration, arguments.scan_registration
    if of_ct is None or of_scan is None:
        return None
    T_world_scan, T_world_ct = (np.array(record.T_world_scan) for record in (of_scan, of_ct))
    return close_transforms(aligned.T_scan_ct, T_world_scan, T_world_ct, aligned.scan_spheres_m)


@dataclass(frozen=True, slots=True)
class _ComparedSurfaces:
    """CT and scan in the scan's frame, and their distances."""

    ct: Surface
    scan: Surface
    score: ChamferScore


def _files(context: JobContext[job.Arguments], compared: _ComparedSurfaces, fused: Fused) -> tuple[ArtefactRef, ...]:
    scale = HeatScale.of(compared.score, ChamferSettings().outlier_m)
    mesh, heat = context.scratch / "ground_truth.ply", context.scratch / "ct_to_scan.ply"
    properties = {"source": fused.source, "sigma_mm": mm(fused.sigma_m)}
    mark = [SIMULATED] if context.arguments.simulated else []
    write_ply(mesh, fused.surface, _MM, properties, [*_COMMENTS, *mark])
    assert compared.score.vertex_distance_m is not None  # asked for above
    write_heat_mesh(heat, compared.ct, compared.score.vertex_distance_m, scale, _MM, mark)
    picture = fusion_picture(compared.ct, compared.scan, compared.score, scale, fused)
    return (
        context.keep_file(mesh, kind="ground_truth_mesh", media_type="model/ply"),
        context.keep_file(heat, kind="fusion_heat_map", media_type="model/ply"),
        context.keep_bytes(picture, kind="fusion_picture", media_type="image/png", name="fusion.png"),
    )


def _measures(aligned: Aligned, loop: TransformLoop | None, score: ChamferScore, fused: Fused) -> dict[str, float]:
    around = {} if loop is None else {
        "loop_closure_mm": mm(loop.worst_m),
        "loop_closure_rms_mm": mm(loop.rms_m),
        "loop_closure_deg": deg(loop.rotation_rad),
    }  # fmt: skip
    return {
        "spheres_compared": float(len(aligned.loop.spheres)),
        "spheres_moved": float(len(aligned.loop.moved)),
        "sphere_distance_change_max_mm": mm(aligned.distances.worst_m),
        "sphere_distance_change_rms_mm": mm(aligned.distances.rms_m),
        "spheres_rms_mm": mm(aligned.loop.rms_m),
        **around,
        "chamfer_ct_scan_mm": mm(score.chamfer_m),
        "chamfer_floor_mm": mm(score.floor_m),
        "ct_to_scan_mm": mm(score.pred_to_gt.mean_m),
        "scan_to_ct_mm": mm(score.gt_to_pred.mean_m),
        "ct_to_scan_median_mm": mm(score.pred_to_gt.median_m),
        "scan_to_ct_median_mm": mm(score.gt_to_pred.median_m),
        "ct_above_scan_mm": mm(fused.ct_offset_m),
        "ct_spread_mm": mm(fused.ct_spread_m),
        **{f"{source.name.lower()}_share": fused.share(source) for source in Source},
        "wound_share": float(fused.wound.mean()),
        "sigma_median_mm": mm(float(np.median(fused.sigma_m))),
        "ground_truth_vertices": float(len(fused.surface.vertices_m)),
        "ground_truth_faces": float(len(fused.surface.faces)),
        "folded_faces": float(fused.folded),
    }
