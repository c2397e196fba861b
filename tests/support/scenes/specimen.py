"""Scores a mesh with the spheres and their posts cut out of it and of its truth."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from drivers.meshes.surface_file import read_surface_file
from service.benchmark.running import compare
from service.computations.benchmark import Score
from service.compute.surfaces.fuse import Markers, compact
from service.compute.surfaces.surface import Surface
from service.core.geometry import inverse
from service.core.units import metres
from service.dataset.records import Mesh
from simulators.scene.world import POST_RADIUS_M


def markers_of(folder: Path) -> tuple[Markers, Markers]:
    """Registration spheres with their posts, and control spheres, of a rendered scene; in its scan's frame."""
    spheres = json.loads((folder / "spheres.json").read_text(encoding="utf-8"))
    T_world_scan = np.array(json.loads((folder / "truth.json").read_text(encoding="utf-8"))["T_world_scan"])
    up = inverse(T_world_scan)[:3, 2]
    radius_m = metres(float(spheres["radius_mm"]))
    return (
        Markers(metres(np.array(spheres["registration_mm"])), radius_m, up, POST_RADIUS_M),
        Markers(metres(np.array(spheres["control_mm"])), radius_m, up),
    )


def specimen_of(surface: Surface, markers: tuple[Markers, ...]) -> Surface:
    """The mesh without the faces that touch a sphere or a post."""
    near = np.any([some.near(surface.vertices_m) for some in markers], axis=0)
    return compact(surface.vertices_m, surface.faces[~near[surface.faces].any(axis=1)])[0]


def score_specimen(mesh: Path, truth: Mesh, markers: tuple[Markers, ...]) -> Score:
    """Compare a mesh that `run_trial` kept (`mesh.ply`, cut to the box of the whole truth), both without markers."""
    file = read_surface_file(mesh, "m")
    bare = specimen_of(Surface(truth.vertices_m, truth.faces), markers)
    found = specimen_of(Surface(file.vertices_m, file.faces), markers)
    return compare(found, Mesh(bare.vertices_m, bare.faces)).score
