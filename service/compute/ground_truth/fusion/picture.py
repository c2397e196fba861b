"""A picture of a fusion: the distances between CT and scan, and from which of the two each part of the result is."""

from __future__ import annotations

import cv2
import numpy as np

from service.compute.ground_truth.distances.chamfer import ChamferScore
from service.compute.ground_truth.distances.heat_map import HeatScale, Panel, heat_picture
from service.compute.ground_truth.fusion.fuse import Fused, Source
from service.compute.ground_truth.surface import Surface

_COLOURS = {Source.CT: (214, 94, 0), Source.SCAN: (0, 114, 178), Source.BLEND: (240, 228, 66)}  # red, green, blue
_WORDS = {Source.CT: "CT orange", Source.SCAN: "scan blue", Source.BLEND: "blend yellow"}


def fusion_picture(ct: Surface, scan: Surface, score: ChamferScore, scale: HeatScale, fused: Fused) -> bytes:
    """A PNG with CT and scan by their distances, and the fused mesh by its sources, seen along one direction.

    Args:
        ct, scan: as they were compared, in one frame.
        score: of the comparison.
        scale: of its colours.
        fused: of both.
    """
    palette = np.array([_COLOURS[source] for source in Source], dtype=np.uint8)
    title = "source: " + ", ".join(f"{_WORDS[s]} {100 * fused.share(s):.0f} %" for s in Source)
    sources = Panel(fused.surface.vertices_m, palette[fused.source], fused.surface.vertex_normals.__getitem__, title)
    picture = heat_picture(ct, scan, score, scale, ("CT", "scan"), (sources,))
    return cv2.imencode(".png", picture)[1].tobytes()
