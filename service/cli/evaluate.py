"""`orthocapture evaluate chamfer`: the paper's Chamfer distance between two surfaces, and the scores beside it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import cv2
import typer
from rich.table import Table

from drivers.meshes.mesh_file import METRES_PER_UNIT, MeshUnit
from drivers.meshes.surface_file import SurfaceFile, read_surface_file
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
from service.compute.surfaces.chamfer import ChamferScore, ChamferSettings, Direction, chamfer
from service.compute.surfaces.heat_map import HeatScale, heat_picture, write_heat_mesh
from service.compute.surfaces.surface import Surface
from service.core.errors import ConfigurationError
from service.core.units import metres, mm


def chamfer_command(
    pred: Annotated[Path, typer.Argument(help="Surface to judge: mesh (OBJ, PLY, STL, OFF, GLB) or point cloud.")],
    gt: Annotated[Path, typer.Argument(help="The ground truth, in the same frame.")],
    spacing_mm: Annotated[float, typer.Option("--spacing-mm", help="Spacing to which both are sampled.")] = 0.1,
    outlier_mm: Annotated[float, typer.Option("--outlier-mm", help="Farther points are left out.")] = 20.0,
    pred_unit: Annotated[MeshUnit, typer.Option("--pred-unit", help="Unit of PRED: mm, m or auto.")] = "auto",
    gt_unit: Annotated[MeshUnit, typer.Option("--gt-unit", help="Unit of GT: mm, m or auto.")] = "auto",
    heat_map: Annotated[
        Path | None, typer.Option("--heat-map", help="Write PRED as PLY, coloured by its distance to GT.")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option("--picture", help="Write a picture (PNG) of both surfaces by their distances.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Chamfer distance between a reconstructed surface and the ground truth, as in the paper.

    Both are sampled with one point per square of the spacing. Distances to the nearest point of the other are
    averaged in each direction, without those beyond the outlier limit; the Chamfer distance is the mean of the two.
    """
    with reporting_errors(json):
        settings = _settings(spacing_mm, outlier_mm)
        _check_out(heat_map, ".ply")
        _check_out(picture, ".png")
        files = (read_surface_file(pred, pred_unit), read_surface_file(gt, gt_unit))
        for path, file in zip((pred, gt), files, strict=True):
            tell_doubt(path, file.polygons_in_doubt)
        judged, truth = (Surface(file.vertices_m, file.faces, file.normals) for file in files)
        score = chamfer(judged, truth, replace(settings, of_vertices=heat_map is not None))
        scale = HeatScale.of(score, settings.outlier_m)
        if heat_map is not None and score.vertex_distance_m is not None:
            write_heat_mesh(heat_map, judged, score.vertex_distance_m, scale, METRES_PER_UNIT[files[0].unit])
        if picture is not None:
            write_whole(picture, cv2.imencode(".png", heat_picture(judged, truth, score, scale))[1].tobytes())
        if json:
            print_json(score_record(score))
            return
        _show(score, files, settings)
        for file in (heat_map, picture):
            if file is not None:
                console.print(f"written: {file} (colours end at {mm(scale.full_m):g} mm)")


def score_record(score: ChamferScore) -> dict[str, Any]:
    """Return the score as plain data; `pred_to_gt` and `gt_to_pred` hold what belongs to one direction."""
    names = [f"{mm(limit):.1f}" if mm(limit) >= 0.1 else f"{mm(limit):g}" for limit in score.thresholds_m]
    return {
        "chamfer_mm": mm(score.chamfer_m),
        "pred_to_gt_mm": mm(score.pred_to_gt.mean_m),
        "gt_to_pred_mm": mm(score.gt_to_pred.mean_m),
        "f_score": dict(zip(names, score.f_scores, strict=True)),
        "excluded": score.pred_to_gt.excluded + score.gt_to_pred.excluded,
        "floor_mm": mm(score.floor_m),
        "n_pred": score.pred_to_gt.n,
        "n_gt": score.gt_to_pred.n,
        "pred_to_gt": _direction_record(score.pred_to_gt, names),
        "gt_to_pred": _direction_record(score.gt_to_pred, names),
    }


def _direction_record(way: Direction, names: list[str]) -> dict[str, Any]:
    return {
        "mean_mm": mm(way.mean_m),
        "median_mm": mm(way.median_m),
        "p95_mm": mm(way.p95_m),
        "floor_mm": mm(way.floor_m),
        "excluded": way.excluded,
        "within": dict(zip(names, way.within, strict=True)),
        "to_surface_mean_mm": None if way.surface_mean_m is None else mm(way.surface_mean_m),
        "to_surface_rms_mm": None if way.surface_rms_m is None else mm(way.surface_rms_m),
        "normal_consistency": way.normal_consistency,
    }


def _settings(spacing_mm: float, outlier_mm: float) -> ChamferSettings:
    for name, value in (("--spacing-mm", spacing_mm), ("--outlier-mm", outlier_mm)):
        if not 0 < value < float("inf"):
            raise typer.BadParameter(f"{name} must be a positive number, not {value:g}")
    return ChamferSettings(metres(spacing_mm), metres(outlier_mm))


def _check_out(file: Path | None, suffix: str) -> None:
    if file is None:
        return
    if file.suffix.lower() != suffix:
        raise ConfigurationError(
            f"this file is written as {suffix[1:].upper()}", where=str(file), remedy=f"Give it a name with {suffix}"
        )
    require_writable(file)


def _show(score: ChamferScore, files: tuple[SurfaceFile, SurfaceFile], settings: ChamferSettings) -> None:
    for name, file in zip(("PRED", "GT"), files, strict=True):
        kind = f"{len(file.faces)} faces" if len(file.faces) else f"{len(file.vertices_m)} points"
        console.print(f"{name}: {kind}; unit {file.unit_evidence}")
    limits = [f"within {mm(limit):g} mm" for limit in score.thresholds_m]
    table = Table("", "points", "excluded", "mean mm", "median mm", "to faces mm", "normals", *limits)
    for name, way in (("PRED to GT (accuracy)", score.pred_to_gt), ("GT to PRED (completeness)", score.gt_to_pred)):
        table.add_row(
            name,
            str(way.n),
            str(way.excluded),
            f"{mm(way.mean_m):.3f}",
            f"{mm(way.median_m):.3f}",
            "–" if way.surface_mean_m is None else f"{mm(way.surface_mean_m):.3f}",
            "–" if way.normal_consistency is None else f"{way.normal_consistency:.3f}",
            *(f"{100 * share:.1f} %" for share in way.within),
        )
    print_table(table)
    scores = ", ".join(
        f"{value:.3f} at {mm(limit):g} mm" for value, limit in zip(score.f_scores, score.thresholds_m, strict=True)
    )
    console.tell(
        (f"Chamfer distance {mm(score.chamfer_m):.3f} mm", "bold"),
        "; equal surfaces would give "
        f"{mm(score.floor_m):.3f} mm at a spacing of {mm(settings.spacing_m):g} mm. F-score {scores}.",
    )


evaluate_app = typer.Typer(
    help="Compare a reconstructed surface with the ground truth.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
evaluate_app.command("chamfer")(chamfer_command)
