"""Computes the ground-truth mesh from the CT and the scan, and the checks that both are in one frame.

The job `fuse` and the command `orthocapture fuse` both call `fuse_meshes`, and say what its result says.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from service.computations import fuse as job
from service.computations.job import JobAnswer, JobContext
from service.computations.records import Point, SpheresFound, matrix
from service.compute.surfaces.align import (
    Aligned,
    MeshSpheres,
    TransformLoop,
    align_spheres,
    close_transforms,
    common_part,
)
from service.compute.surfaces.chamfer import ChamferScore, ChamferSettings, chamfer
from service.compute.surfaces.fuse import Fused, FusionSettings, Markers, Source, without_markers
from service.compute.surfaces.fuse import fuse as fuse_surfaces
from service.compute.surfaces.heat_map import HeatScale, fusion_picture, write_heat_mesh
from service.compute.surfaces.overlap import Box, Prism, RegionCorrection, outline, seen_along
from service.compute.surfaces.surface import Surface, write_ply
from service.core.errors import DataError
from service.core.geometry import Array, Transform, apply, inverse
from service.core.records.base import ArtefactRef
from service.core.units import deg, metres, mm
from service.core.words import SIMULATED
from service.machine.resources import large_arrays_returned

_MM = 1e-3  # metres in the unit of a job's files
_FRAME = "in the frame of the scan, mm"
MEANINGS = "source 0: CT, 1: scan, 2: blend; sigma along the normal"
STAGES = 4  # of a fusion, for its progress


@dataclass(frozen=True, slots=True)
class MeshFusionSettings:
    """The settings of a fusion.

    Attributes:
        radius_m: the spheres' radius.
        blend_m: the width of the overlap over which the sources change.
        spacing_m: the spacing of the samples for the Chamfer distance.
        post_radius_m: the radius of the spheres' posts, which are then cut out with the spheres; None: no cut.
        heat_map: true to measure the distance of each of the CT's vertices too, for `write_heat_map`.
    """

    radius_m: float
    blend_m: float
    spacing_m: float
    post_radius_m: float | None = None
    heat_map: bool = True


@dataclass(frozen=True, slots=True)
class FusedMeshes:
    """A CT and a scan that were brought into one frame, compared and fused.

    Attributes:
        aligned: the CT's pose in the frame of the scan, by the spheres.
        ct: the part of the CT that the scan has too, in the frame of the scan.
        scan: the scan.
        score: the distances between the two.
        fused: the fused mesh.
        wound_m: (K, 3) outline of the wound's region; empty without a wound.
    """

    aligned: Aligned
    ct: Surface = field(repr=False)
    scan: Surface = field(repr=False)
    score: ChamferScore
    fused: Fused
    wound_m: tuple[Point, ...]

    def measures(self) -> dict[str, float]:
        """Return what was measured, by the names under which a run records it."""
        aligned, score, fused = self.aligned, self.score, self.fused
        return {
            "spheres_compared": float(len(aligned.loop.spheres)),
            "spheres_moved": float(len(aligned.loop.moved)),
            "sphere_distance_change_max_mm": mm(aligned.distances.worst_m),
            "sphere_distance_change_rms_mm": mm(aligned.distances.rms_m),
            "spheres_rms_mm": mm(aligned.loop.rms_m),
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

    @property
    def scale(self) -> HeatScale:
        """The scale of colours for the distances."""
        return HeatScale.of(self.score, ChamferSettings().outlier_m)

    def write_mesh(self, path: Path, metres_per_unit: float, comments: Sequence[str] = ()) -> None:
        """Write the fused mesh as PLY, with the source and the standard deviation of each vertex."""
        properties = {"source": self.fused.source, "sigma_mm": mm(self.fused.sigma_m)}
        write_ply(path, self.fused.surface, metres_per_unit, properties, comments)

    def write_heat_map(self, path: Path, metres_per_unit: float, comments: Sequence[str] = ()) -> None:
        """Write the CT as PLY, coloured by its distance to the scan. Its distances must have been asked for."""
        assert self.score.vertex_distance_m is not None  # by MeshFusionSettings.heat_map
        write_heat_mesh(path, self.ct, self.score.vertex_distance_m, self.scale, metres_per_unit, comments)

    def picture(self) -> bytes:
        """Draw a PNG: CT and scan by their distances, the fused mesh by its sources."""
        return fusion_picture(self.ct, self.scan, self.score, self.scale, self.fused)


def fuse_meshes(
    read_ct: Callable[[], Surface],
    scan: Surface,
    aligned: Aligned,
    settings: MeshFusionSettings,
    progress: Callable[[str, int, int], None],
    corrections: Sequence[RegionCorrection] = (),
) -> FusedMeshes:
    """Bring a CT into the frame of a scan, compare both, and fuse them.

    Args:
        read_ct: returns the CT's mesh in its own frame. Most of its faces may be noise: unless the caller holds it,
            their memory is freed as soon as they are left out.
        scan: the scan.
        aligned: the CT's pose by the spheres of both.
        settings: the settings of the comparison and of the fusion.
        progress: called with what is done, how much is done, and the total.
        corrections: the regions in which people decided which source counts, in the frame of the scan.

    Raises:
        ComputeError: the two surfaces are nowhere near each other.
    """
    up = upwards(scan)
    progress("distances", 1, STAGES)
    common = common_part(read_ct().moved(aligned.T_scan_ct), aligned, settings.radius_m)
    score = chamfer(
        common.ct, scan, ChamferSettings(settings.spacing_m, to_faces=False, of_vertices=settings.heat_map)
    )
    progress("fusion", 2, STAGES)
    fusion = FusionSettings(
        blend_m=settings.blend_m,
        sigma_ct_m=aligned.sigma_ct_m,
        sigma_scan_m=aligned.sigma_scan_m,
        alignment_covariance=aligned.covariance,
        least_part_m2=0.0,  # small parts are left out already
    )
    fused = fuse_surfaces(common.ct, scan, up, fusion, corrections, common.taken)
    wound_m = _wound(fused, up)
    if settings.post_radius_m is not None:
        markers = Markers(aligned.scan_spheres_m, settings.radius_m, up, settings.post_radius_m)
        fused = without_markers(fused, markers)
    progress("pictures", 3, STAGES)
    return FusedMeshes(aligned, common.ct, scan, score, fused, wound_m)


def upwards(scan: Surface) -> Array:
    """Return a vector (3,) away from the table: a scan sees its scene from above only, so its faces point up."""
    return scan.area_vectors_m2.sum(axis=0)


@large_arrays_returned()
def fuse(context: JobContext[job.Arguments]) -> JobAnswer:
    """Fuse the meshes of a job, and close the loop through the images if there are any."""
    arguments = context.arguments
    context.progress("spheres", 0, STAGES)
    aligned = align_spheres(_spheres(arguments.ct), _spheres(arguments.scan))
    scan = Surface.kept(context.input(arguments.scan_mesh))
    frames, up = _frames(arguments, aligned), upwards(scan)
    corrections = tuple(_correction(region, frames, up) for region in arguments.regions)
    settings = MeshFusionSettings(arguments.radius_m, arguments.blend_m, arguments.spacing_m, arguments.post_radius_m)
    found = fuse_meshes(
        lambda: Surface.kept(context.input(arguments.ct_mesh)), scan, aligned, settings, context.progress, corrections
    )
    loop = _loop(arguments, aligned)
    answer = job.Answer(
        T_scan_ct=matrix(aligned.T_scan_ct),
        covariance=matrix(aligned.covariance),
        T_scan_ct_by_images=None if loop is None else matrix(loop.T_scan_scan @ aligned.T_scan_ct),
        wound_m=found.wound_m,
        regions=arguments.regions,
        taken_away=aligned.only_ct,
    )
    return JobAnswer(found.measures() | _loop_measures(loop), _files(context, found), answer)


def _spheres(found: SpheresFound) -> MeshSpheres:
    details = found.details.spheres
    return MeshSpheres(
        np.array(found.spheres_m),
        np.array([sphere.covariance_m2 for sphere in details]),
        metres(np.array([sphere.rms_mm for sphere in details])),
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


def _loop_measures(loop: TransformLoop | None) -> dict[str, float]:
    if loop is None:
        return {}
    return {
        "loop_closure_mm": mm(loop.worst_m),
        "loop_closure_rms_mm": mm(loop.rms_m),
        "loop_closure_deg": deg(loop.rotation_rad),
    }


def _files(context: JobContext[job.Arguments], found: FusedMeshes) -> tuple[ArtefactRef, ...]:
    mesh, heat = context.scratch / "ground_truth.ply", context.scratch / "ct_to_scan.ply"
    mark = [SIMULATED] if context.arguments.simulated else []
    found.write_mesh(mesh, _MM, [_FRAME, MEANINGS, *mark])
    found.write_heat_map(heat, _MM, mark)
    return (
        context.keep_file(mesh, kind="ground_truth_mesh", media_type="model/ply"),
        context.keep_file(heat, kind="fusion_heat_map", media_type="model/ply"),
        context.keep_bytes(found.picture(), kind="fusion_picture", media_type="image/png", name="fusion.png"),
    )
