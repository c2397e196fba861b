"""`orthocapture fuse`: one ground-truth mesh from a CT mesh and a scan."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from drivers.interfaces import ScannedMesh
from drivers.meshes.mesh_file import METRES_PER_UNIT, MeshUnit, read_mesh_file
from service.cli.common import (
    JsonOption,
    console,
    print_json,
    progress_bar,
    reporting_errors,
    require_writable,
    tell_doubt,
    write_whole,
)
from service.compute.ground_truth.align import TRANSPORT_GATE_M, Aligned, CommonPart, align, common_part
from service.compute.ground_truth.chamfer import ChamferScore, ChamferSettings, chamfer
from service.compute.ground_truth.fuse import Fused, FusionSettings, Markers, Source, fuse, without_markers
from service.compute.ground_truth.heat_map import HeatScale, fusion_picture, write_heat_mesh
from service.compute.ground_truth.surface import Surface, write_ply
from service.core.units import metres, mm


def fuse_command(
    ct: Annotated[Path, typer.Option("--ct", help="Mesh of the CT (OBJ, PLY or STL), with the spheres.")],
    scan: Annotated[Path, typer.Option("--scan", help="Mesh of the scan, with the spheres.")],
    radius_mm: Annotated[float, typer.Option("--radius-mm", help="Radius of the spheres.")],
    out: Annotated[Path, typer.Option("--out", help="The PLY to write, in the scan's frame and unit.")],
    ct_unit: Annotated[MeshUnit, typer.Option("--ct-unit", help="Unit of the CT's mesh: mm, m or auto.")] = "auto",
    scan_unit: Annotated[MeshUnit, typer.Option("--scan-unit", help="Unit of the scan: mm, m or auto.")] = "auto",
    blend_mm: Annotated[float, typer.Option("--blend-mm", help="Width of the overlap of CT and scan.")] = 3.0,
    spacing_mm: Annotated[
        float, typer.Option("--spacing-mm", help="Spacing of the samples of the Chamfer distance CT to scan.")
    ] = 0.1,
    post_radius_mm: Annotated[
        float | None,
        typer.Option("--cut-posts-mm", help="Cut out the spheres, and posts of this radius under them.", min=0),
    ] = None,
    heat_map: Annotated[
        Path | None, typer.Option("--heat-map", help="Write the CT as PLY, coloured by its distance to the scan.")
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option("--picture", help="Write a PNG: CT and scan by their distances, the result by its sources."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Fuse a CT mesh and a scan: the CT in the wound, the scan outside, blended between.

    The CT comes into the scan's frame by the spheres. Spheres that the scan lacks were taken away before it, and are
    cut out of the CT. Each vertex written has its source (0: CT, 1: scan, 2: blend)
    and its standard deviation in millimetres. Exit status 1: distances between spheres changed by more than 0.3 mm.
    """
    with reporting_errors(json):
        for name, value in (("--radius-mm", radius_mm), ("--blend-mm", blend_mm), ("--spacing-mm", spacing_mm)):
            if not 0 < value < float("inf"):
                raise typer.BadParameter(f"{name} must be a positive number, not {value:g}")
        for file in (out, heat_map, picture):
            if file is not None:
                require_writable(file)
        of_scan, of_ct = read_mesh_file(scan, scan_unit), read_mesh_file(ct, ct_unit)
        for file, read in ((scan, of_scan), (ct, of_ct)):
            tell_doubt(file, read.findings["polygons_in_doubt"])
        scanned, tomogram = _surface(of_scan), _surface(of_ct)
        with progress_bar(quiet=json) as report:
            report("spheres", 0, 3)
            aligned = align(tomogram, scanned, metres(radius_mm))
            tomogram = tomogram.moved(aligned.T_scan_ct)
            report("distances", 1, 3)
            common = common_part(tomogram, aligned, metres(radius_mm))
            score = chamfer(common.ct, scanned, ChamferSettings(metres(spacing_mm), of_vertices=heat_map is not None))
            report("fusion", 2, 3)
            fused = _fused(common, scanned, aligned, metres(blend_mm))
        if post_radius_mm is not None:
            up = scanned.area_vectors_m2.sum(axis=0)
            fused = without_markers(
                fused, Markers(aligned.scan_spheres_m, metres(radius_mm), up, metres(post_radius_mm))
            )
        unit_m = METRES_PER_UNIT[of_scan.unit]
        write_ply(out, fused.surface, unit_m, {"source": fused.source, "sigma_mm": mm(fused.sigma_m)}, _COMMENTS)
        scale = HeatScale.of(score, ChamferSettings().outlier_m)
        if heat_map is not None and score.vertex_distance_m is not None:
            write_heat_mesh(heat_map, common.ct, score.vertex_distance_m, scale, unit_m)
        if picture is not None:
            write_whole(picture, fusion_picture(common.ct, scanned, score, scale, fused))
        record = fusion_record(aligned, score, fused)
        if json:
            print_json(record)
        else:
            _show(record)
            console.print(f"written: {out}")
    if not aligned.passed:
        raise typer.Exit(1)


_COMMENTS = ("source 0: CT, 1: scan, 2: blend; sigma along the normal",)


def _surface(file: ScannedMesh) -> Surface:
    return Surface(file.mesh.vertices_m, file.mesh.faces.astype(np.int64))


def _fused(common: CommonPart, scan: Surface, aligned: Aligned, blend_m: float) -> Fused:
    # A scan sees its scene from above only: its faces together point up.
    settings = FusionSettings(
        blend_m=blend_m,
        sigma_ct_m=aligned.sigma_ct_m,
        sigma_scan_m=aligned.sigma_scan_m,
        alignment_covariance=aligned.covariance,
        least_part_m2=0.0,  # small parts are left out already
    )
    return fuse(common.ct, scan, scan.area_vectors_m2.sum(axis=0), settings, removed=common.taken)


def fusion_record(aligned: Aligned, score: ChamferScore, fused: Fused) -> dict[str, Any]:
    """Return what was measured as plain data in millimetres."""
    return {
        "spheres": len(aligned.loop.spheres),
        "spheres_moved": len(aligned.loop.moved),
        "taken_away": len(aligned.only_ct),
        "spheres_rms_mm": mm(aligned.loop.rms_m),
        "T_scan_ct": aligned.T_scan_ct.tolist(),
        "distance_change_mm": mm(aligned.distances.worst_m),
        "distance_change_rms_mm": mm(aligned.distances.rms_m),
        "distance_change_limit_mm": mm(TRANSPORT_GATE_M),
        "passed": aligned.passed,
        "chamfer_ct_scan_mm": mm(score.chamfer_m),
        "chamfer_floor_mm": mm(score.floor_m),
        "ct_to_scan_mm": mm(score.pred_to_gt.mean_m),
        "scan_to_ct_mm": mm(score.gt_to_pred.mean_m),
        "excluded": score.pred_to_gt.excluded + score.gt_to_pred.excluded,
        "ct_above_scan_mm": mm(fused.ct_offset_m),
        "share": {source.name.lower(): fused.share(source) for source in Source},
        "wound_share": float(fused.wound.mean()),
        "folded_faces": fused.folded,
        "vertices": len(fused.surface.vertices_m),
        "faces": len(fused.surface.faces),
    }


def _show(record: dict[str, Any]) -> None:
    console.print(
        f"{record['spheres']} spheres in both, rms {record['spheres_rms_mm']:.3f} mm, "
        f"{record['spheres_moved']} moved, {record['taken_away']} only in the CT, which are cut out; "
        f"largest change of a distance {record['distance_change_mm']:.3f} mm "
        f"(limit {record['distance_change_limit_mm']:g} mm)"
    )
    console.tell(
        (f"Chamfer distance CT to scan {record['chamfer_ct_scan_mm']:.3f} mm", "bold"),
        f" (equal surfaces would give "
        f"{record['chamfer_floor_mm']:.3f} mm); the CT is {record['ct_above_scan_mm']:+.3f} mm above the scan",
    )
    shares = ", ".join(f"{name} {100 * share:.0f} %" for name, share in record["share"].items())
    console.print(f"{record['vertices']} vertices: {shares}; {record['folded_faces']} folded faces")
