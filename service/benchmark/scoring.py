"""Scores the mesh of a method, in the world frame: cut to the box of the truth, and compared as in the paper."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import trimesh

from service.computations.benchmark import Score
from service.compute.surfaces.chamfer import ChamferScore, ChamferSettings, chamfer
from service.compute.surfaces.fuse import compact
from service.compute.surfaces.heat_map import HeatScale, heat_picture
from service.compute.surfaces.overlap import Box
from service.compute.surfaces.surface import Surface, write_ply
from service.core.errors import DataError
from service.core.geometry import inverse
from service.core.units import mm
from service.dataset.exporter import png
from service.dataset.records import DataSet, Mesh
from service.machine.resources import large_arrays_returned

MARGIN_M = 0.002
SCORED, HEAT_MAP = "mesh.ply", "heat_map.png"  # what is written of a scored mesh
_POINTS = 200_000  # of the truth, by which its box is found


@dataclass(frozen=True, slots=True)
class Scored:
    """A mesh that was compared: what is left of it, with the comparison."""

    surface: Surface = field(repr=False)
    chamfer: ChamferScore = field(repr=False)
    score: Score


@large_arrays_returned()
def score_mesh(found: Surface, truth: Mesh, settings: ChamferSettings | None = None) -> Scored:
    """Compare a mesh with the truth; both in the world frame, metres.

    The mesh is first cropped to the smallest bounding box of the truth, enlarged by MARGIN_M: methods reconstruct the
    whole room, the truth only the specimen.

    Raises:
        DataError: nothing of the mesh is within the box.
        ComputeError: the meshes cannot be compared.
    """
    cut = _cropped(found, _box_around(truth, MARGIN_M))
    if not cut.is_mesh or not cut.area_m2 > 0:
        raise DataError(
            "the mesh has no face within the box of the ground truth",
            remedy="Check that the mesh is the file as the method wrote it, and that it belongs to this data set",
        )
    return compare(cut, truth, settings, 100 * max(0.0, 1 - cut.area_m2 / found.area_m2))


def _box_around(mesh: Mesh, margin_m: float) -> Box:
    """Return the smallest box around a mesh, and a margin."""
    points = mesh.vertices_m[:: max(1, len(mesh.vertices_m) // _POINTS)]
    to_origin, extents = trimesh.bounds.oriented_bounds(points)
    return Box(inverse(np.asarray(to_origin)), np.asarray(extents) + 2 * margin_m)


def _cropped(surface: Surface, box: Box) -> Surface:
    """Return the faces whose centres are in a box."""
    within = np.empty(len(surface.faces), dtype=np.bool_)
    for block in surface.blocks():
        within[block] = box.contains(surface.vertices_m[surface.faces[block]].mean(axis=1))
    return compact(surface.vertices_m, surface.faces[within])[0]


def compare(
    cut: Surface, truth: Mesh, settings: ChamferSettings | None = None, outside_percent: float = 0.0
) -> Scored:
    """Compare a mesh with the truth as they are; both in the world frame, metres.

    Args:
        cut: the mesh without what the truth does not cover.
        truth: the mesh that it is compared with.
        settings: the settings of the comparison.
        outside_percent: share of the method's surface that was cut off before.

    Raises:
        ComputeError: the meshes cannot be compared.
    """
    compared = chamfer(cut, Surface(truth.vertices_m, truth.faces), settings)
    forth, back = compared.pred_to_gt, compared.gt_to_pred
    consistency = [n for n in (forth.normal_consistency, back.normal_consistency) if n is not None]
    f_score_05, f_score_10 = compared.f_scores
    return Scored(
        cut,
        compared,
        Score(
            chamfer_mm=mm(compared.chamfer_m),
            accuracy_mm=mm(forth.mean_m),
            completeness_mm=mm(back.mean_m),
            floor_mm=mm(compared.floor_m),
            spacing_mm=mm((settings or ChamferSettings()).spacing_m),
            f_score_05=f_score_05,
            f_score_10=f_score_10,
            normal_consistency=sum(consistency) / len(consistency),
            outside_percent=outside_percent,
            excluded_percent=100 * (forth.excluded + back.excluded) / (forth.n + back.n),
            seen_percent=100 * back.within[1],
        ),
    )


def write_scored(scored: Scored, dataset: DataSet, folder: Path, settings: ChamferSettings | None = None) -> None:
    """Write the mesh as it was scored (`mesh.ply`, metres, world frame) and its heat maps (`heat_map.png`).

    Both say so if the data set is simulated.
    """
    comments = ["world frame, metres; cut to the box of the truth", dataset.mark]
    write_ply(folder / SCORED, scored.surface, 1.0, {}, list(filter(None, comments)))
    scale = HeatScale.of(scored.chamfer, (settings or ChamferSettings()).outlier_m)
    truth = Surface(dataset.mesh.vertices_m, dataset.mesh.faces)
    names = ("prediction", "simulated truth" if dataset.simulated else "truth")
    picture = heat_picture(scored.surface, truth, scored.chamfer, scale, names)
    (folder / HEAT_MAP).write_bytes(png(picture, dataset.mark))
