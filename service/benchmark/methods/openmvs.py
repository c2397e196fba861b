"""OpenMVS: depth maps, a Delaunay mesh, refined against the images."""

from __future__ import annotations

from service.benchmark.method import Command, Method, Workplace
from service.benchmark.shared_parts import at, triangulation

MESH = "scene_mesh_refined.ply"


def commands(place: Workplace) -> tuple[Command, ...]:
    """OpenMVS chooses neighbouring views by common points, so features are triangulated first."""
    work, dense = str(place.work), str(place.work / "dense")
    images = str(place.work / "dense" / "images")
    return (
        triangulation(place, place.work / "dense"),
        ("InterfaceCOLMAP", "-w", work, "-i", dense, "-o", "scene.mvs", "--image-folder", images),
        ("DensifyPointCloud", "-w", work, "-i", "scene.mvs", "-o", "scene_dense.mvs"),
        ("ReconstructMesh", "-w", work, "-i", "scene_dense.mvs", "-o", "scene_mesh.ply"),
        ("RefineMesh", "-w", work, "-i", "scene_dense.mvs", "-m", "scene_mesh.ply", "-o", MESH),
    )


KIND = Method(
    "openmvs",
    "OpenMVS",
    "OpenMVS 2.3 (needs no GPU)",
    "colmap-pinhole",
    commands,
    at(MESH),
    programs=("InterfaceCOLMAP", "DensifyPointCloud", "ReconstructMesh", "RefineMesh"),
)
