"""`orthocapture spheres` and `layout`: find the spheres in a scan, CT mesh or point cloud; can they be told apart?"""

from __future__ import annotations

import dataclasses
import json as json_module
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
import typer
from numpy.typing import NDArray
from rich.table import Table

from drivers.meshes.mesh_file import METRES_PER_UNIT, MeshUnit, credible_unit, read_mesh_file
from drivers.meshes.point_cloud import is_point_cloud, read_point_cloud
from service.cli.common import (
    JsonOption,
    console,
    print_json,
    print_table,
    reporting_errors,
    require_writable,
    tell_doubt,
    write_whole,
)
from service.cli.ending import ExitStatus
from service.computations.conversion import judged_layout, measured_sphere
from service.compute.images.photographs import read_image
from service.compute.layout.ambiguity import LayoutReport, check_layout
from service.compute.layout.moves import Move, suggest_moves
from service.compute.layout.photographs import CALIBRATED, SpherePhotograph, layout_from_photographs
from service.compute.markers.detect import detect_spheres
from service.compute.poses.pose_files import read_camera_json, read_spheres_json
from service.compute.surfaces.mesh_spheres import (
    MeasuredRadius,
    MeshSphere,
    SphereLimits,
    locate_spheres,
    seen_radius,
)
from service.core.errors import ComputeError, DataError
from service.core.geometry import Array
from service.core.units import metres, mm
from service.core.words import counted

_NAMED = 3  # most spheres listed in an error

SeedsOption = Annotated[
    str | None,
    typer.Option(
        "--seeds", help="A point at or near each sphere, in mm in the mesh's frame: x,y,z;x,y,z, or a JSON file."
    ),
]


def spheres_command(
    mesh: Annotated[Path, typer.Option("--mesh", help="Mesh (OBJ, PLY or STL) or point cloud (PLY or text).")],
    radius_mm: Annotated[float, typer.Option("--radius-mm", help="Radius of the spheres.")],
    out: Annotated[Path, typer.Option("--out", help="The spheres.json to write.")],
    expect: Annotated[int | None, typer.Option("--expect", help="Number of spheres that must be found.")] = None,
    seeds: SeedsOption = None,
    mesh_unit: Annotated[MeshUnit, typer.Option("--mesh-unit", help="Unit of the mesh: mm, m or auto.")] = "auto",
    max_rms_mm: Annotated[
        float | None,
        typer.Option("--max-rms-mm", help="Largest rms residual of a sphere; default: 2.5 % of the radius.", min=0),
    ] = None,
    max_radius_off_mm: Annotated[
        float | None,
        typer.Option(
            "--max-radius-off-mm",
            help="Largest error of a sphere's fitted radius; default: 4 % of the radius, more with noise.",
            min=0,
        ),
    ] = None,
    max_form_mm: Annotated[
        float | None,
        typer.Option("--max-form-mm", help="Largest form error of a sphere; default: 1 % of the radius.", min=0),
    ] = None,
    min_cap_deg: Annotated[
        float | None,
        typer.Option("--min-cap-deg", help="Smallest angle of the visible cap; default: 50°.", min=0, max=180),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Find every sphere of a given radius in a mesh or point cloud, with its covariance and fit."""
    with reporting_errors(json):
        require_writable(out)
        radius_m = metres(_positive(radius_mm))
        limits = _limits(radius_m, max_rms_mm, max_radius_off_mm, max_form_mm, min_cap_deg)
        try:
            found = spheres_of(mesh, radius_m, mesh_unit, expect, seeds, limits)
        except ComputeError as error:
            raise _with_limits(error, limits, radius_mm) from error
        document = {
            "radius_mm": mm(radius_m),
            "registration_mm": [mm(sphere.centre_m).tolist() for sphere in found],
            "control_mm": [],
            "details": [measured_sphere(sphere).plain() for sphere in found],
        }
        write_whole(out, json_module.dumps(document, indent=1))
        if json:
            print_json(document)
            return
        table = Table("", "x mm", "y mm", "z mm", "sigma mm", "rms mm", "radius mm", "coverage")
        for number, sphere in enumerate(found):
            table.add_row(
                str(number),
                *(f"{mm(value):.3f}" for value in sphere.centre_m),
                f"{mm(float(np.sqrt(np.trace(sphere.covariance)))):.4f}",
                f"{mm(sphere.rms_m):.3f}",
                f"{mm(sphere.radius_residual_m):+.3f} ± {mm(sphere.radius_sigma_m):.3f}",
                f"{sphere.coverage:.2f}",
            )
        print_table(table)
        console.print(f"written: {out}")


def _positive(radius_mm: float) -> float:
    if not 0 < radius_mm < float("inf"):
        raise typer.BadParameter(f"--radius-mm must be a positive number, not {radius_mm:g}")
    return radius_mm


def _limits(
    radius_m: float,
    max_rms_mm: float | None,
    max_radius_off_mm: float | None,
    max_form_mm: float | None,
    min_cap_deg: float | None,
) -> SphereLimits:
    """Return the default limits with those given instead, as fractions of the radius."""
    given = {"max_rms": max_rms_mm, "max_radius_residual": max_radius_off_mm, "max_form": max_form_mm}
    changed = {name: metres(value) / radius_m for name, value in given.items() if value is not None}
    if min_cap_deg is not None:
        half = np.radians(min_cap_deg / 2)
        changed |= {"min_cap_deg": min_cap_deg, "min_coverage": min(0.05, 0.7 * (1 - float(np.cos(half))) / 2)}
    return dataclasses.replace(SphereLimits(), **changed)


def _with_limits(error: ComputeError, limits: SphereLimits, radius_mm: float) -> ComputeError:
    """Return the error with the limits that were applied and the options that change them."""
    words = (
        f"Judged by --max-rms-mm {limits.max_rms * radius_mm:.3g}, "
        f"--max-radius-off-mm {limits.max_radius_residual * radius_mm:.3g}, "
        f"--max-form-mm {limits.max_form * radius_mm:.3g}, --min-cap-deg {limits.min_cap_deg:g}"
    )
    return ComputeError(error.what, where=error.where, remedy=f"{error.remedy}. {words}")


def spheres_of(
    mesh: Path,
    radius_m: float,
    unit: MeshUnit,
    expected: int | None,
    seeds: str | None,
    limits: SphereLimits | None = None,
) -> tuple[MeshSphere, ...]:
    """Return the spheres in a mesh or point cloud file, in metres, in the order of the seeds if given.

    Raises:
        DataError: the file or the seeds cannot be used.
        ComputeError: the expected spheres are not there.
    """
    seeds_m = read_seeds(seeds)
    if expected is not None and seeds_m is not None and len(seeds_m) != expected:
        raise DataError(
            f"{counted(len(seeds_m), 'seed')} given for {counted(expected, 'expected sphere')}",
            remedy="Give one for each",
        )
    normals: Array | None = None
    faces: NDArray[np.integer] = np.empty((0, 3), dtype=np.int64)
    if mesh.is_file() and is_point_cloud(mesh):
        cloud = read_point_cloud(mesh, unit, any_size=True)
        vertices, normals, found = cloud.points_m, cloud.normals, cloud.unit
    else:
        scan = read_mesh_file(mesh, unit, any_size=True)
        tell_doubt(mesh, scan.findings["polygons_in_doubt"])
        vertices, faces, found = scan.mesh.vertices_m, scan.mesh.faces, scan.unit
    try:
        return locate_spheres(vertices, faces, radius_m, expected, limits, normals=normals, seeds_m=seeds_m)
    except ComputeError as error:
        # Spheres of the given radius confirm the unit of a single object; without them, only its size can.
        credible_unit(mesh, vertices / METRES_PER_UNIT[found], unit)
        seen = seen_radius(vertices, faces, radius_m, limits, normals=normals)
        # A scan may hold some other balls; suggest their radius only if there are at least as many as expected.
        if seen is None or (expected is not None and len(seen.spheres) < expected):
            raise
        raise _of_another_radius(error, seen, radius_m) from error


def _of_another_radius(error: ComputeError, seen: MeasuredRadius, radius_m: float) -> ComputeError:
    """Return the error for spheres of another radius, which it names."""
    count = len(seen.spheres)
    where = ", ".join("({:.1f}, {:.1f}, {:.1f})".format(*mm(s.centre_m)) for s in seen.spheres[:_NAMED])
    more = ", …" if count > _NAMED else ""
    return ComputeError(
        f"{error.what}. There {'is 1 sphere' if count == 1 else f'are {count} spheres'} of radius "
        f"{mm(seen.radius_m):.2f} mm, at {where}{more} mm; the radius given may be off by 4 % at most",
        where=error.where,
        remedy=f"Measure a sphere: if these are the ones, give --radius-mm {mm(seen.radius_m):.2f}"
        + (", half of what was given: the radius, not the diameter" if seen.radius_m < 0.55 * radius_m else ""),
    )


def read_seeds(text: str | None) -> Array | None:
    """Return seeds (K, 3) in metres from text or a file in millimetres; None if none are given.

    Args:
        text: "x,y,z;x,y,z", or the path of a JSON file with a list of [x, y, z], or with an object that has such a
            list under registration_mm, such as spheres.json.

    Raises:
        DataError: the seeds cannot be read.
    """
    if text is None:
        return None
    path = Path(text)
    try:
        if path.is_file():
            document: object = json_module.loads(path.read_text(encoding="utf-8"))
            if isinstance(document, dict):
                document = cast("dict[str, Any]", document)["registration_mm"]
            seeds = np.array(document, dtype=np.float64)
        else:
            rows = [row.split(",") for row in text.split(";") if row.strip()]
            seeds = np.array([[float(word) for word in row] for row in rows])
    except (ValueError, KeyError, TypeError, OSError) as error:
        raise DataError(f"the seeds cannot be read ({error})", where=text, remedy="Give x,y,z;x,y,z in mm") from error
    if seeds.ndim != 2 or seeds.shape[1] != 3 or len(seeds) == 0:
        raise DataError("the seeds are not points x,y,z", where=text, remedy="Give x,y,z;x,y,z in mm, or a JSON file")
    return metres(seeds)


# --- `layout`: whether the spheres can be told apart in their present layout --------------------------------------


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
