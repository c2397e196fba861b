"""A surface as a binary PLY file with a colour and a distance at every vertex."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from service.compute.ground_truth.distances.heat_map import HeatScale
from service.compute.ground_truth.surface import Surface
from service.core.geometry import Array
from service.core.units import mm


def write_heat_mesh(
    path: Path, surface: Surface, distance_m: Array, scale: HeatScale, metres_per_unit: float
) -> None:
    """Write a surface with, at each vertex, its distance in millimetres (`distance_mm`) and the colour of that.

    Args:
        path: of the file.
        surface: metres.
        distance_m: (V,).
        scale: of the colours.
        metres_per_unit: unit of the file's coordinates, so that it lies over the file that was judged.
    """
    vertex = np.zeros(
        len(surface.vertices_m),
        dtype=[*((name, "<f4") for name in ("x", "y", "z")), *((n, "u1") for n in _COLOURS), ("distance_mm", "<f4")],
    )
    for k, name in enumerate(("x", "y", "z")):
        vertex[name] = surface.vertices_m[:, k] / metres_per_unit
    colours = scale.colours(distance_m)
    for k, name in enumerate(_COLOURS):
        vertex[name] = colours[:, k]
    vertex["distance_mm"] = mm(distance_m)
    face = np.zeros(len(surface.faces), dtype=[("count", "u1"), ("vertices", "<i4", 3)])
    face["count"], face["vertices"] = 3, surface.faces
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment colours end at {mm(scale.full_m):g} mm; grey is beyond {mm(scale.outlier_m):g} mm",
        f"element vertex {len(vertex)}",
        *(f"property float {name}" for name in ("x", "y", "z")),
        *(f"property uchar {name}" for name in _COLOURS),
        "property float distance_mm",
        f"element face {len(face)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    with path.open("wb") as stream:
        stream.write(("\n".join(lines) + "\n").encode("ascii"))
        stream.write(vertex.tobytes())
        stream.write(face.tobytes())


_COLOURS = ("red", "green", "blue")
