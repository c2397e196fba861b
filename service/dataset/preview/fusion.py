"""The fused ground truth of a run on the screen: where each part of it comes from, and how certain it is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from service.compute.ground_truth.distances import PointIndex
from service.compute.ground_truth.fuse import Source
from service.compute.ground_truth.surface import read_ply
from service.core.errors import DataError
from service.core.geometry import Array
from service.core.units import metres
from service.dataset.preview.records import DecidedRegion, GroundTruthPreview
from service.dataset.recorded_fusion import RecordedFusion
from service.dataset.scene_view import MeshColours

PICTURE = "fusion_picture"  # kind of its artefact
_HIGH = 99.0  # percentile of the sigmas at the end of the colours
#: What a vertex can come from, in the order of the colours; the names and colours of the fusion's picture.
_PARTS = ((Source.CT, "CT", "#d65e00"), (Source.BLEND, "blend", "#f0e442"), (Source.SCAN, "scan", "#0072b2"))


@dataclass(frozen=True, slots=True)
class VertexFigures:
    """Colours of points on the mesh, for their source and for their standard deviation."""

    sources: MeshColours
    sigmas: MeshColours


def shown_ground_truth(fusion: RecordedFusion, sources: str, sigmas: str, sigma_high_mm: float) -> GroundTruthPreview:
    """The figures of a fusion as it was recorded, with the names of the files of its two coloured meshes."""
    measures = fusion.measures
    return GroundTruthPreview(
        step=fusion.step,
        ct_share=measures["ct_share"],
        scan_share=measures["scan_share"],
        blend_share=measures["blend_share"],
        sigma_median_mm=measures["sigma_median_mm"],
        sigma_high_mm=sigma_high_mm,
        distance_change_max_mm=measures["sphere_distance_change_max_mm"],
        loop_closure_mm=measures.get("loop_closure_mm"),
        faces=int(measures["ground_truth_faces"]),
        regions=tuple(DecidedRegion(region.source, region.by) for region in fusion.answer.regions),
        sources=sources,
        sigmas=sigmas,
    )


def vertex_figures(path: Path, points_m: Array) -> tuple[VertexFigures, float]:
    """Source and sigma at points (V, 3) of the mesh, each that of the nearest vertex; and a high sigma, in mm.

    Args:
        path: of the recorded mesh, a PLY in millimetres with `source` and `sigma_mm` at each vertex.
        points_m: of a simplified mesh in the same frame.

    Raises:
        DataError: it has no such properties.
    """
    columns, _ = read_ply(path)
    if not {"source", "sigma_mm"} <= set(columns):
        raise DataError("the ground truth's mesh has neither source nor sigma", where=path.name)
    vertices_m = metres(np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1))
    _, nearest = PointIndex(vertices_m).nearest(points_m)
    sigma_mm = columns["sigma_mm"].astype(np.float64)
    high_mm = float(np.percentile(sigma_mm, _HIGH))
    places = np.zeros(len(Source))
    for place, (source, _, _) in enumerate(_PARTS):
        places[source] = place
    values = places[columns["source"].astype(np.int64)][nearest]
    classes = tuple((name, colour) for _, name, colour in _PARTS)
    return VertexFigures(
        MeshColours(values, "source", "", classes),
        MeshColours(np.minimum(sigma_mm[nearest], high_mm), "stated sigma (mm)", "%{intensity:.3f} mm"),
    ), high_mm
