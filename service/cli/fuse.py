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
from service.cli.ending import ExitStatus
from service.computations.fuse.compute import MEANINGS, STAGES, FusedMeshes, MeshFusionSettings, fuse_meshes
from service.compute.surfaces.align import align
from service.compute.surfaces.fuse import Source
from service.compute.surfaces.surface import Surface
from service.core.gates import judge
from service.core.protocol import Gate
from service.core.records.run_events import GateVerdict
from service.core.units import metres

TRANSPORT_GATE = Gate(
    measure="sphere_distance_change_max_mm",
    max=0.3,
    unit="mm",
    why="the distances of the spheres must survive the transport",
)  # as the shipped protocols have it


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
        settings = MeshFusionSettings(
            radius_m=metres(radius_mm),
            blend_m=metres(blend_mm),
            spacing_m=metres(spacing_mm),
            post_radius_m=None if post_radius_mm is None else metres(post_radius_mm),
            heat_map=heat_map is not None,
        )
        with progress_bar(quiet=json) as report:
            report("spheres", 0, STAGES)
            aligned = align(tomogram, scanned, settings.radius_m)
            found = fuse_meshes(lambda: tomogram, scanned, aligned, settings, report)
        unit_m = METRES_PER_UNIT[of_scan.unit]
        found.write_mesh(out, unit_m, [MEANINGS])
        if heat_map is not None:
            found.write_heat_map(heat_map, unit_m)
        if picture is not None:
            write_whole(picture, found.picture())
        (verdict,) = judge([TRANSPORT_GATE], found.measures())
        record = fusion_record(found, verdict)
        if json:
            print_json(record)
        else:
            _show(record)
            console.print(f"written: {out}")
    if not verdict.passed:
        raise typer.Exit(ExitStatus.FAILED)


def _surface(file: ScannedMesh) -> Surface:
    return Surface(file.mesh.vertices_m, file.mesh.faces.astype(np.int64))


_SAME_NAMES = ("chamfer_ct_scan_mm", "chamfer_floor_mm", "ct_to_scan_mm", "scan_to_ct_mm")  # as a run has them


def fusion_record(found: FusedMeshes, verdict: GateVerdict) -> dict[str, Any]:
    """Return what was measured as plain data in millimetres, with the verdict on the spheres' distances."""
    aligned, score, measured = found.aligned, found.score, found.measures()
    return {
        "spheres": int(measured["spheres_compared"]),
        "spheres_moved": int(measured["spheres_moved"]),
        "taken_away": len(aligned.only_ct),
        "spheres_rms_mm": measured["spheres_rms_mm"],
        "T_scan_ct": aligned.T_scan_ct.tolist(),
        "distance_change_mm": measured["sphere_distance_change_max_mm"],
        "distance_change_rms_mm": measured["sphere_distance_change_rms_mm"],
        "distance_change_limit_mm": verdict.maximum,
        "passed": verdict.passed,
        **{name: measured[name] for name in _SAME_NAMES},
        "excluded": score.pred_to_gt.excluded + score.gt_to_pred.excluded,
        "ct_above_scan_mm": measured["ct_above_scan_mm"],
        "share": {source.name.lower(): measured[f"{source.name.lower()}_share"] for source in Source},
        "wound_share": measured["wound_share"],
        "folded_faces": int(measured["folded_faces"]),
        "vertices": int(measured["ground_truth_vertices"]),
        "faces": int(measured["ground_truth_faces"]),
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
