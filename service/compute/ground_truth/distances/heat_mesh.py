"""A surface as a PLY file with a colour and a distance at every vertex."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from service.compute.ground_truth.distances.heat_map import HeatScale
from service.compute.ground_truth.ply import write_ply
from service.compute.ground_truth.surface import Surface
from service.core.geometry import Array
from service.core.units import mm


def write_heat_mesh(
    path: Path,
    surface: Surface,
    distance_m: Array,
    scale: HeatScale,
    metres_per_unit: float,
    comments: Sequence[str] = (),
) -> None:
    """Write a surface with, at each vertex, its distance in millimetres (`distance_mm`) and the colour of that.

    Args:
        path: of the file.
        surface: metres.
        distance_m: (V,); what lies beyond the limit of the scale may be infinite, and is written as the limit.
        scale: of the colours.
        metres_per_unit: unit of the file's coordinates, so that it lies over the file that was judged.
        comments: further lines for the header, in ASCII.
    """
    colours = scale.colours(distance_m)
    properties = {name: colours[:, k] for k, name in enumerate(("red", "green", "blue"))}
    told = f"colours end at {mm(scale.full_m):g} mm; grey is beyond {mm(scale.outlier_m):g} mm"
    distance_mm = mm(np.minimum(distance_m, scale.outlier_m))
    write_ply(path, surface, metres_per_unit, {**properties, "distance_mm": distance_mm}, [told, *comments])
