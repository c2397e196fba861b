"""A surface as arrays: a triangle mesh, or the points of a cloud."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from service.core.geometry import Array, Transform, apply

IntArray = NDArray[np.int64]


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
            return cls(mesh["vertices_m"].astype(np.float64), mesh["faces"].astype(np.int64))

    @property
    def is_mesh(self) -> bool:
        """Whether there are faces."""
        return len(self.faces) > 0

    @cached_property
    def area_vectors_m2(self) -> Array:
        """(F, 3) outward normal of each face, as long as its area."""
        a, b, c = (self.vertices_m[self.faces[:, k]] for k in range(3))
        return 0.5 * np.cross(b - a, c - a)

    @cached_property
    def face_normals(self) -> Array:
        """(F, 3) unit normals; zero for faces without area."""
        length = np.linalg.norm(self.area_vectors_m2, axis=1, keepdims=True)
        return self.area_vectors_m2 / np.maximum(length, 1e-300)

    @cached_property
    def vertex_normals(self) -> Array:
        """(V, 3) area-weighted unit normals; zero for vertices without faces."""
        corner = self.faces.ravel()
        vectors = np.repeat(self.area_vectors_m2, 3, axis=0)
        total = np.stack([np.bincount(corner, vectors[:, k], len(self.vertices_m)) for k in range(3)], axis=1)
        return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)

    @cached_property
    def area_m2(self) -> float:
        """Area of all faces."""
        return float(np.linalg.norm(self.area_vectors_m2, axis=1).sum())

    def moved(self, T_a_b: Transform) -> Surface:
        """This surface, of frame b, in frame a."""
        normals = None if self.normals is None else self.normals @ T_a_b[:3, :3].T
        return Surface(apply(T_a_b, self.vertices_m), self.faces, normals)
