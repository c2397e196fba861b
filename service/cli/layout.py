"""`orthocapture layout`: check whether the spheres can be told apart in their present layout."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.table import Table

from drivers.meshes.mesh_file import MeshUnit
from service.cli.common import JsonOption, console, print_json, print_table, reporting_errors
from service.cli.exit_status import ExitStatus
from service.cli.spheres import spheres_of
from service.computations.conversion import judged_layout
from service.compute.images.photographs import read_image
from service.compute.layout.ambiguity import LayoutReport, check_layout
from service.compute.layout.moves import Move, suggest_moves
from service.compute.layout.photographs import CALIBRATED, SpherePhotograph, layout_from_photographs
from service.compute.markers.detect import detect_spheres
from service.compute.poses.pose_files import read_camera_json, read_spheres_json
from service.core.errors import ComputeError
from service.core.geometry import Array
from service.core.units import metres, mm


def layout_command(
    spheres: Annotated[Path | None, typer.Option("--spheres", help="spheres.json with known centres.")] = None,
    mesh: Annotated[Path | None, typer.Option("--mesh", help="Scan, CT mesh or point cloud.")] = None,
    photo: Annotated[
        list[Path] | None, typer.Option("--photo", help="Photograph that shows all spheres; may be repeated.")
    ] = None,
    camera: Annotated[Path | None, typer.Option("--camera", help="camera.json of the photographs.")] = None,
    radius_mm: Annotated[float | None, typer.Option("--radius-mm", help="Radius of the spheres.")] = None,
    mesh_unit: Annotated[MeshUnit, typer.Option("--mesh-unit", help="Unit of the mesh: mm, m or auto.")] = "auto",
    json: JsonOption = False,
) -> None:
    """Check how well the spheres can be told apart, and suggest which to move. Exit status 1: some must be moved."""
    with reporting_errors(json):
        centres, covariances, radius_m = _centres(spheres, mesh, photo or [], camera, radius_mm, mesh_unit)
        report = check_layout(centres, covariances, radius_m=radius_m)
        if json:
            print_json(judged_layout(report).plain())
        else:
            _show(report, centres, radius_m)
    if not report.passed:
        raise typer.Exit(ExitStatus.FAILED)


def _centres(
    spheres: Path | None,
    mesh: Path | None,
    photos: list[Path],
    camera: Path | None,
    radius_mm: float | None,
    mesh_unit: MeshUnit,
) -> tuple[Array, Array | None, float]:
    if (spheres is not None) + (mesh is not None) + bool(photos) != 1:
        raise typer.BadParameter("give one of --spheres, --mesh and --photo")
    if spheres is not None:
        known = read_spheres_json(spheres)
        return np.concatenate([known.centres_m, known.control_m]), None, known.radius_m
    if radius_mm is None:
        raise typer.BadParameter("--mesh and --photo need --radius-mm")
    radius_m = metres(radius_mm)
    if mesh is not None:
        found = spheres_of(mesh, radius_m, mesh_unit, None, None)
        return np.array([s.centre_m for s in found]), np.array([s.covariance for s in found]), radius_m
    if camera is None:
        raise typer.BadParameter("--photo needs --camera")
    model = read_camera_json(camera)
    seen = [SpherePhotograph.of(model, detect_spheres(read_image(path), model)) for path in photos]
    found = layout_from_photographs(seen, radius_m, CALIBRATED)
    return found.centres_m, found.covariance, radius_m


def _show(report: LayoutReport, centres: Array, radius_m: float) -> None:
    table = Table("sphere", "x mm", "y mm", "z mm", "margin mm")
    for number, (centre, margin) in enumerate(zip(centres, report.sphere_margins_m, strict=True)):
        shown = f"{mm(margin):.2f}" if np.isfinite(margin) else "more"
        table.add_row(str(number), *(f"{mm(v):.1f}" for v in centre), shown)
    print_table(table)
    if report.margin.upper_m > report.margin.lower_m:
        margin = report.margin
        console.print(f"margin {mm(margin.value_m):.2f} mm, {mm(margin.lower_m):.2f} to {mm(margin.upper_m):.2f}")
    seen = ", ".join(f"{k}: {mm(v):.1f}" for k, v in report.margin_by_count_m.items() if np.isfinite(v))
    console.print(f"least misfit in mm of a wrong assignment, by spheres seen: {seen}")
    for problem in report.problems:
        console.tell(("to do:", "bold red"), f" {problem}")
    for move in _moves(centres, radius_m) if report.problems else ():
        x, y, z = mm(move.by_m)
        console.print(
            f"  move sphere {move.sphere} by about ({x:.0f}, {y:.0f}, {z:.0f}) mm: "
            f"the margin is then {mm(move.margin_m):.2f} mm"
        )
    if report.passed:
        console.tell(("The spheres can be told apart.", "bold green"))


def _moves(centres: Array, radius_m: float) -> tuple[Move, ...]:
    """Return suggested moves; empty if no single move helps, which the report's problems also say."""
    _, _, axes = np.linalg.svd(centres - centres.mean(axis=0), full_matrices=False)
    try:
        return suggest_moves(centres, up=axes[2], radius_m=radius_m)
    except ComputeError:
        return ()
