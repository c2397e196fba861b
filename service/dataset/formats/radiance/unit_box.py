"""The unit box that radiance fields want the scene in, and the way back from there for their meshes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from service.core.geometry import Array, Transform
from service.dataset.posed.records import DataSet, Mesh


@dataclass(frozen=True, slots=True)
class UnitBox:
    """A cube around the scene: `unit = scale (world - centre_m)` is within -½ … ½ of each axis."""

    centre_m: Array  # (3,)
    scale: float  # 1/m

    def pose(self, T_world_camera: Transform) -> Transform:
        """The pose with its position relative to the centre, still in metres."""
        T = T_world_camera.copy()
        T[:3, 3] -= self.centre_m
        return T

    def record(self, dataset: DataSet) -> dict[str, object]:
        """As JSON, for whoever brings a mesh back."""
        return {
            "simulated": dataset.simulated,
            "centre_m": self.centre_m.tolist(),
            "scale_per_m": self.scale,
            "meaning": "unit = scale_per_m * (world - centre_m)",
        }


def unit_box(mesh: Mesh, fill: float = 0.9) -> UnitBox:
    """The box of a mesh, of whose half-edge the mesh fills this share."""
    low, high = mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)
    return UnitBox((low + high) / 2, fill / float((high - low).max()))


def world_of_ngp_mesh(vertices: Array, box: UnitBox) -> Array:
    """World points (N, 3), in metres, of a mesh that Instant-NGP saved from our export.

    It cycles axes: (x, y, z) of its mesh is (Y, Z, X) of the poses that it was given. Scale and the equal offsets of
    the three axes are taken out again when it saves a mesh (`nerf_matrix_to_ngp` in its
    include/neural-graphics-primitives/nerf_loader.h).
    """
    return np.stack([vertices[:, 2], vertices[:, 0], vertices[:, 1]], axis=1) + box.centre_m


def world_of_neus2_mesh(vertices: Array, box: UnitBox) -> Array:
    """World points (N, 3), in metres, of a mesh that NeuS2 saved from our export: `from_na` cycles no axes."""
    return vertices + box.centre_m
