"""A triangle mesh at which the rays of pixels are cast."""

from __future__ import annotations

import importlib
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.core.errors import ConfigurationError, DataError
from service.core.geometry import Array, Transform

_CHUNK = 500_000  # faces whose corners are in memory at a time


class RayMesh:
    """A triangle mesh in the world frame, with a tree for rays that is built once, at the first ray of all images."""

    def __init__(self, vertices_m: Array, faces: NDArray[np.integer]) -> None:
        """Take vertices (V, 3) in metres and faces (F, 3); faces without area are left out.

        Raises:
            DataError: no face has an area, or a vertex is not finite.
        """
        if not np.isfinite(vertices_m).all():
            raise DataError("the mesh has vertices that are not finite", remedy="Export the mesh again")
        self._centre_m = 0.5 * (vertices_m.min(axis=0) + vertices_m.max(axis=0)) if len(vertices_m) else np.zeros(3)
        normal, offset = _planes(vertices_m, faces)
        kept = np.isfinite(normal[:, 0])
        if not kept.any():
            raise DataError("the mesh has no face with an area", remedy="Use a mesh, not a point cloud")
        self._normal, self._offset_m = normal[kept], offset[kept]
        # Single precision is enough near the mesh's centre, wherever the world's origin lies.
        self._near = np.ascontiguousarray(vertices_m - self._centre_m, dtype=np.float32)
        self._faces = np.ascontiguousarray(faces[kept], dtype=np.int32)

    @cached_property
    def _scene(self) -> Any:
        """The tree; many exports need none. Raises ConfigurationError without embreex."""
        return _tree(self._near, self._faces)

    def first_face(self, eye_m: Array, directions: NDArray[np.float32]) -> NDArray[np.int32]:
        """The index (N,) of the first face that each ray from the eye (3,) along (N, 3) hits; -1 for none.

        Raises:
            ConfigurationError: embreex, which casts the rays, is not installed.
        """
        origin = (eye_m - self._centre_m).astype(np.float32)
        return np.asarray(self._scene.run(np.broadcast_to(origin, directions.shape), directions), dtype=np.int32)

    def depths(self, T_world_camera: Transform, rays: Array) -> Array:
        """Depth (N,) along z at which rays (N, 3) of a camera, with z = 1, meet the surface; NaN where they do not.

        Raises:
            ConfigurationError: embreex, which casts the rays, is not installed.
        """
        eye, directions = T_world_camera[:3, 3], rays @ T_world_camera[:3, :3].T
        face = self.first_face(eye, np.ascontiguousarray(directions, dtype=np.float32))
        normal = self._normal[face]
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (self._offset_m[face] - normal @ eye) / np.einsum("ij,ij->i", normal, directions)
        return np.where((face >= 0) & np.isfinite(depth) & (depth > 0), depth, np.nan)

    def planes_seen(self, T_world_camera: Transform) -> Array:
        """(F + 1, 4) each face's unit normal towards the camera, in its frame, and n · p (≤ 0) for its points p.

        The last row, which the index -1 names, is zero.
        """
        R, eye = T_world_camera[:3, :3], T_world_camera[:3, 3]
        planes = np.zeros((len(self._normal) + 1, 4))
        np.matmul(self._normal, R, out=planes[:-1, :3])
        np.subtract(self._offset_m, self._normal @ eye, out=planes[:-1, 3])
        planes[planes[:, 3] > 0] *= -1
        return planes


def _planes(vertices_m: Array, faces: NDArray[np.integer]) -> tuple[Array, Array]:
    """Unit normals (F, 3) and offsets n · p (F,); NaN for faces without area."""
    normal, offset = np.empty((len(faces), 3)), np.empty(len(faces))
    for begin in range(0, len(faces), _CHUNK):
        chosen = slice(begin, begin + _CHUNK)
        a, b, c = (vertices_m[faces[chosen, k]] for k in range(3))
        cross = np.cross(b - a, c - a)
        with np.errstate(invalid="ignore", divide="ignore"):
            normal[chosen] = cross / np.linalg.norm(cross, axis=1, keepdims=True)
        offset[chosen] = np.sum(normal[chosen] * a, axis=1)
    return normal, offset


def _tree(vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> Any:
    try:
        rtcore, meshes = (
            importlib.import_module(f"embreex.{name}") for name in ("rtcore_scene", "mesh_construction")
        )
    except ImportError as error:
        raise ConfigurationError(
            "embreex, which casts rays at a mesh, is not installed",
            remedy="Compute depth on a machine with an x86-64 processor",
        ) from error
    scene = rtcore.EmbreeScene()
    meshes.TriangleMesh(scene, vertices, faces)
    scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))  # the first ray builds the tree
    return scene
