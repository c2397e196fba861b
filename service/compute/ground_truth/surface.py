"""Holds a surface as arrays, a triangle mesh or the points of a cloud, and reads and writes it as binary PLY."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from service.core.errors import DataError
from service.core.geometry import Array, Transform, apply

IntArray = NDArray[np.int64]
FACES = 25_000  # in a block, so that what is computed of its corners stays in the processor's cache


@dataclass(frozen=True)
class Surface:
    """Vertices (V, 3) in metres with faces (F, 3), or points with (0, 3) faces and perhaps unit normals (V, 3)."""

    vertices_m: Array = field(repr=False)
    faces: IntArray = field(repr=False)
    normals: Array | None = field(default=None, repr=False)

    @classmethod
    def kept(cls, path: Path) -> Surface:
        """Return the mesh of a CT or a scan as an import keeps it: an .npz file of `vertices_m` and `faces`."""
        with np.load(path, allow_pickle=False) as mesh:
            return cls(mesh["vertices_m"].astype(np.float64, copy=False), mesh["faces"])  # their integers are short

    @property
    def is_mesh(self) -> bool:
        """True if the surface has faces."""
        return len(self.faces) > 0

    @cached_property
    def area_vectors_m2(self) -> Array:
        """(F, 3) outward normal of each face, as long as its area."""
        out = np.empty((len(self.faces), 3))
        for block in self.blocks():
            out[block] = self.area_vectors_of(block)
        return out

    def blocks(self) -> Iterator[slice]:
        """Yield the faces in blocks, in order."""
        for begin in range(0, len(self.faces), FACES):
            yield slice(begin, min(begin + FACES, len(self.faces)))

    def touching(self, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return (F,) which faces have one of the chosen (V,) vertices."""
        one, other, third = self.faces.T
        return chosen[one] | chosen[other] | chosen[third]

    def area_vectors_of(self, chosen: IntArray | slice) -> Array:
        """Return (N, 3) `area_vectors_m2` of some faces alone."""
        corners = self.faces[chosen]
        out = np.empty((len(corners), 3))
        for begin in range(0, len(corners), FACES):
            part = slice(begin, begin + FACES)
            a, b, c = (self.vertices_m[corners[part, k]] for k in range(3))
            out[part] = 0.5 * np.cross(b - a, c - a)
        return out

    def normals_of(self, chosen: IntArray | slice) -> Array:
        """Return (N, 3) unit normals of some faces; zero for faces without area."""
        vectors = self.area_vectors_of(chosen)
        return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)

    @cached_property
    def face_areas_m2(self) -> Array:
        """(F,) area of each face."""
        out = np.empty(len(self.faces))
        for block in self.blocks():
            out[block] = np.linalg.norm(self.area_vectors_of(block), axis=1)
        return out

    @cached_property
    def face_normals(self) -> Array:
        """(F, 3) unit normals; zero for faces without area."""
        return self.normals_of(slice(None))

    @cached_property
    def vertex_normals(self) -> Array:
        """(V, 3) area-weighted unit normals; zero for vertices without faces."""
        total = self.sums_at_vertices(self.area_vectors_of)
        return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)

    def sums_at_vertices(self, of_faces: Callable[[slice], Array]) -> Array:
        """Sum (V, K), over the faces around each vertex, what a function gives for a block of faces (N, K)."""
        total: Array | None = None
        for block in self.blocks():
            values = of_faces(block)
            if total is None:
                total = np.zeros((len(self.vertices_m), values.shape[1]))
            corner = self.faces[block].ravel()
            for k in range(values.shape[1]):
                np.add.at(total[:, k], corner, np.repeat(values[:, k], 3))
        return np.zeros((len(self.vertices_m), 3)) if total is None else total

    @cached_property
    def area_m2(self) -> float:
        """Area of all faces."""
        return float(self.face_areas_m2.sum())

    def moved(self, T_a_b: Transform) -> Surface:
        """Return this surface, of frame b, in frame a."""
        normals = None if self.normals is None else self.normals @ T_a_b[:3, :3].T
        return Surface(apply(T_a_b, self.vertices_m), self.faces, normals)


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
        path: the file to write.
        surface: metres.
        metres_per_unit: unit of the file's coordinates.
        properties: (V,) numbers for each name: fractional ones are written as float, others as unsigned bytes.
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
    """Encode a binary, little-endian PLY.

    Args:
        columns: (V,) float32, float64 or uint8 for each property of the vertices, x, y and z first.
        faces: (F, 3) indices of vertices.
        comments: lines for the header, in ASCII.
    """
    return b"".join(_ply_blocks(columns, faces, comments))


def _ply_blocks(
    columns: Mapping[str, NDArray[np.generic]], faces: NDArray[np.integer], comments: Sequence[str]
) -> Iterator[bytes]:
    """Yield the file in blocks."""
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
    """Read the properties of the vertices (V,) by name, and the faces (F, 3), of a file that this module wrote.

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
