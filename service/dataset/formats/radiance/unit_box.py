"""The unit box that radiance fields want the scene in, and the way back from there for their meshes."""

from __future__ import annotations

from dataclasses import dataclass

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

    def record(self, dataset: DataSet, mesh_axes: tuple[int, int, int]) -> dict[str, object]:
        """As JSON, to bring a saved mesh to the world: scale, centre, and which of its axes are the world's x, y, z.

        The programs undo the scale when they save a mesh, so only the centre has to be added.
        """
        return {
            "simulated": dataset.simulated,
            "centre_m": self.centre_m.tolist(),
            "scale_per_m": self.scale,
            "mesh_axes": list(mesh_axes),
            "meaning": "unit = scale_per_m * (world - centre_m); for a saved mesh, "
            "world = mesh[:, mesh_axes] + centre_m",
        }


def unit_box(mesh: Mesh, fill: float = 0.9) -> UnitBox:
    """The box about a mesh whose longest extent fills this share of the box's edge."""
    low, high = mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)
    return UnitBox((low + high) / 2, fill / float((high - low).max()))
