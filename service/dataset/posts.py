"""The posts of a run's registration spheres, which are not recorded: the scan's board or an arm shows their place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from service.computations.register import ARM
from service.compute.pixels.masks import Cylinder, WorldSphere, posts_below
from service.core.errors import ConfigurationError
from service.core.geometry import Array, apply, inverse
from service.dataset.records import Mesh, PosedView
from service.dataset.summary import RunSummary
from service.rig import RigSection, parse_recorded_rig

_CANDIDATES = 300  # faces whose normals are tried as the board's
_WITHIN, _LEVEL = 0.7, 0.996  # cosines: of the board from the cameras' direction, of level faces from the board
_LEAST_LEVEL = 0.05  # share of the surface that must be level


@dataclass(frozen=True, slots=True)
class Posts:
    """The posts of the spheres.

    Attributes:
        cylinders: one for each post, as thick as its sphere.
        words: a text on what is known of them, to follow the number of spheres.
    """

    cylinders: tuple[Cylinder, ...]
    words: str


@dataclass(frozen=True, slots=True)
class _Ground:
    """The plane on which the posts stand: unit normal (3,) upwards, and height along it, in the frame of the scan."""

    up: Array
    height_m: float


def posts_of(summary: RunSummary, spheres: Sequence[WorldSphere], views: Sequence[PosedView]) -> Posts:
    """Return the posts below spheres, along the normal of the board in the scan, or the z axis of an arm's base.

    They end on the board or, if the scan shows none, on the table that the rig file states, on which the board lies.
    """
    vertices_m, faces = summary.scan_mesh()
    scan = Mesh(np.asarray(vertices_m, dtype=np.float64), np.asarray(faces, dtype=np.int64))
    eyes = np.mean([view.T_world_camera[:3, 3] for view in views], axis=0)
    up = upwards(scan, eyes - np.mean(scan.vertices_m, axis=0))
    if up.any():
        return Posts(_down_to(_Ground(up, np.inf), scan, spheres), f", and the posts below {len(spheres)} of them")
    table = _table(summary)
    if table is None:
        return Posts(
            (),
            "; posts are not masked, because the scan shows no board on which they stand, and no arm and rig file "
            "say where the table is",
        )
    words = (
        f", and the posts below {len(spheres)} of them, down to the table of the rig file, because the scan shows no "
        "board"
    )
    return Posts(_down_to(table, scan, spheres), words)


def _down_to(ground: _Ground, scan: Mesh, spheres: Sequence[WorldSphere]) -> tuple[Cylinder, ...]:
    """Return a post below each sphere, down to the ground and at least to the lowest point of the scan."""
    lowest = min(ground.height_m, float((scan.vertices_m @ ground.up).min()))
    return tuple(
        post
        for sphere in spheres
        for post in posts_below(
            [sphere],
            ground.up,
            max(sphere.radius_m, float(sphere.centre_m @ ground.up) - lowest),
            sphere.radius_m,
        )
    )


def _table(summary: RunSummary) -> _Ground | None:
    """Return the table at a station, from the rig file and a registration of an arm's poses; None without either."""
    registrations = summary.registrations()
    registered = next((registrations[name] for name in reversed(ARM) if name in registrations), None)
    rig = None if registered is None else _rig(summary)
    if registered is None or rig is None:
        return None
    for station, T_world_base in registered.T_world_station.items():
        if station in rig.stations:
            T_scan_base = inverse(np.array(registered.T_world_scan)) @ np.array(T_world_base)
            top = np.array(rig.stations[station].scene_centre_m) - [0, 0, rig.collision.table_below_scene_m]
            up = T_scan_base[:3, 2]  # a rig file has upright arms only
            return _Ground(up, float(apply(T_scan_base, top) @ up))
    return None


def _rig(summary: RunSummary) -> RigSection | None:
    """Return the rig of a run; None if it was imported, or if an earlier version wrote what this one cannot read."""
    if summary.root.origin == "imported":
        return None
    recorded = summary.root.rig
    source = summary.store.artefact_path(recorded.sha256).read_bytes()
    try:
        return parse_recorded_rig(source, Path(recorded.original_name)).section
    except ConfigurationError:
        return None


def upwards(mesh: Mesh, about: Array) -> Array:
    """Return the board's unit normal (3,): the direction within 45° of `about` to which most surface is level.

    Zero where no direction has a twentieth of the surface: the mesh shows no board.
    """
    a, b, c = (mesh.vertices_m[mesh.faces[:, k]] for k in range(3))
    vector = np.cross(b - a, c - a)
    area = np.linalg.norm(vector, axis=1)
    normal = vector / np.maximum(area, 1e-300)[:, None]
    up = about / np.linalg.norm(about)
    normal *= np.where(normal @ up < 0, -1.0, 1.0)[:, None]  # of a scan, faces may turn either way
    candidates = normal[:: max(1, len(normal) // _CANDIDATES)]
    candidates = candidates[candidates @ up > _WITHIN]
    if not len(candidates):
        return np.zeros(3)
    level = np.array([area[normal @ candidate > _LEVEL].sum() for candidate in candidates])
    best = int(level.argmax())
    if level[best] < _LEAST_LEVEL * area.sum():
        return np.zeros(3)
    mean = (area[:, None] * normal)[normal @ candidates[best] > _LEVEL].sum(axis=0)
    return mean / np.linalg.norm(mean)
