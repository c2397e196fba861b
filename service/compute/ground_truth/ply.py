"""Meshes with properties at their vertices as binary PLY files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from service.compute.ground_truth.surface import IntArray, Surface
from service.core.errors import DataError

_STORED = {"f": "<f4", "u": "u1", "b": "u1"}
_NAMES = {"<f4": "float", "<f8": "double", "|u1": "uchar"}
_KINDS = {name: kind for kind, name in _NAMES.items()}
_ROWS = 500_000  # written at a time
_FACE = np.dtype([("count", "u1"), ("vertices", "<i4", 3)])


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
    columns = {name: surface.vertices_m[:, k] / metres_per_unit for k, name in enumerate("xyz")}
    columns |= {name: np.asarray(values) for name, values in properties.items()}
    stored = {name: values.astype(_STORED[values.dtype.kind]) for name, values in columns.items()}
    with path.open("wb") as file:
        file.writelines(_ply_blocks(stored, surface.faces, comments))


def ply_bytes(
    columns: Mapping[str, NDArray[np.generic]], faces: NDArray[np.integer], comments: Sequence[str] = ()
) -> bytes:
    """A binary, little-endian PLY.

    Args:
        columns: for each property of the vertices, x, y and z first, (V,) float32, float64 or uint8.
        faces: (F, 3).
        comments: lines for the header, in ASCII.
    """
    return b"".join(_ply_blocks(columns, faces, comments))


def _ply_blocks(
    columns: Mapping[str, NDArray[np.generic]], faces: NDArray[np.integer], comments: Sequence[str]
) -> Iterator[bytes]:
    """The file in blocks."""
    kinds = {name: values.dtype.newbyteorder("<").str for name, values in columns.items()}
    vertices = len(columns["x"])
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {comment}" for comment in comments),
        f"element vertex {vertices}",
        *(f"property {_NAMES[kind]} {name}" for name, kind in kinds.items()),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    yield ("\n".join(lines) + "\n").encode("ascii")
    for begin in range(0, vertices, _ROWS):
        vertex = np.zeros(min(_ROWS, vertices - begin), dtype=list(kinds.items()))
        for name, values in columns.items():
            vertex[name] = values[begin : begin + _ROWS]
        yield vertex.tobytes()
    for begin in range(0, len(faces), _ROWS):
        face = np.zeros(min(_ROWS, len(faces) - begin), dtype=_FACE)
        face["count"], face["vertices"] = 3, faces[begin : begin + _ROWS]
        yield face.tobytes()


def read_ply(path: Path) -> tuple[dict[str, NDArray[np.generic]], IntArray]:
    """The properties of the vertices (V,) by name, and the faces (F, 3), of a file that this module wrote.

    Raises:
        DataError: another program wrote the file, or its end is missing.
    """
    data = path.read_bytes()
    head, _, body = data.partition(b"end_header\n")
    kinds: list[tuple[str, str]] = []
    counts: dict[str, int] = {}
    try:
        for words in (line.split() for line in head.decode("ascii").splitlines()):
            if words[0] == "element":
                counts[words[1]] = int(words[2])
            elif words[0] == "property" and words[1] != "list":
                kinds.append((words[2], _KINDS[words[1]]))
        vertex = np.frombuffer(body, dtype=kinds, count=counts["vertex"])
        face = np.frombuffer(body, dtype=_FACE, count=counts["face"], offset=vertex.nbytes)
    except (ValueError, KeyError, IndexError, UnicodeDecodeError) as error:
        raise DataError(
            "no PLY file of this program, or cut short", where=str(path), remedy="Write it again"
        ) from error
    return {name: vertex[name] for name, _ in kinds}, face["vertices"].astype(np.int64)
