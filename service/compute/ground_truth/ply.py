"""Writes meshes with properties at their vertices as binary PLY files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from service.compute.ground_truth.surface import Surface

_NAMES = {"f": ("<f4", "float"), "u": ("u1", "uchar"), "b": ("u1", "uchar")}


def write_ply(
    path: Path,
    surface: Surface,
    metres_per_unit: float,
    properties: Mapping[str, NDArray[np.generic]],
    comments: Sequence[str] = (),
) -> None:
    """Write a surface.

    Args:
        path: of the file.
        surface: metres.
        metres_per_unit: unit of the file's coordinates.
        properties: for each name (V,) numbers: fractional ones are written as float, others as unsigned bytes.
        comments: lines for the header, in ASCII.
    """
    columns = {name: surface.vertices_m[:, k] / metres_per_unit for k, name in enumerate(("x", "y", "z"))}
    columns |= {name: np.asarray(values) for name, values in properties.items()}
    kinds = {name: _NAMES[values.dtype.kind] for name, values in columns.items()}
    vertex = np.zeros(len(surface.vertices_m), dtype=[(name, stored) for name, (stored, _) in kinds.items()])
    for name, values in columns.items():
        vertex[name] = values
    face = np.zeros(len(surface.faces), dtype=[("count", "u1"), ("vertices", "<i4", 3)])
    face["count"], face["vertices"] = 3, surface.faces
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {comment}" for comment in comments),
        f"element vertex {len(vertex)}",
        *(f"property {told} {name}" for name, (_, told) in kinds.items()),
        f"element face {len(face)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    with path.open("wb") as stream:
        stream.write(("\n".join(lines) + "\n").encode("ascii"))
        stream.write(vertex.tobytes())
        stream.write(face.tobytes())
