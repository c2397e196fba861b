"""A surface as arrays: a triangle mesh, or the points of a cloud."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

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
        """The mesh of a CT or a scan as an import keeps it: an .npz file of `vertices_m` and `faces`."""
        with np.load(path, allow_pickle=False) as mesh:
            return cls(mesh["vertices_m"].astype(np.float64, copy=False), mesh["faces"])  # their integers are short

    @property
    def is_mesh(self) -> bool:
        """Whether there are faces."""
        return len(self.faces) > 0

    @cached_property
    def area_vectors_m2(self) -> Array:
        """(F, 3) outward normal of each face, as long as its area."""
        out = np.empty((len(self.faces), 3))
        for block in self.blocks():
            out[block] = self.area_vectors_of(block)
        return out

    def blocks(self) -> Iterator[slice]:
        """The faces in blocks, in order."""
        for begin in range(0, len(self.faces), FACES):
            yield slice(begin, min(begin + FACES, len(self.faces)))

    def touching(self, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(F,) which faces have one of the chosen (V,) vertices."""
        one, other, third = self.faces.T
        return chosen[one] | chosen[other] | chosen[third]

    def area_vectors_of(self, chosen: IntArray | slice) -> Array:
        """(N, 3) `area_vectors_m2` of some faces alone."""
        corners = self.faces[chosen]
        out = np.empty((len(corners), 3))
        for begin in range(0, len(corners), FACES):
            part = slice(begin, begin + FACES)
            a, b, c = (self.vertices_m[corners[part, k]] for k in range(3))
            out[part] = 0.5 * np.cross(b - a, c - a)
        return out

    def normals_of(self, chosen: IntArray | slice) -> Array:
        """(N, 3) unit normals of some faces; zero for faces without area."""
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
        """(V, K) sums over the faces around each vertex of what a function gives for a block of faces (N, K)."""
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
        """This surface, of frame b, in frame a."""
        normals = None if self.normals is None else self.normals @ T_a_b[:3, :3].T
        return Surface(apply(T_a_b, self.vertices_m), self.faces, normals)
