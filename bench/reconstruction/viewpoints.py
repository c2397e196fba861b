"""The viewpoints of `protocols/exvivo_spine.yaml`, the paper's 108 from two stations, or a choice of fewer."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench.scenes import CACHE, Shot, render_scene
from service.compute.pixels.splits import sparse_choice
from service.core.geometry import Array
from simulators.scene.world import SCENE_CENTRE_M, Scene
from tests.support.boards.board_sessions import plan

_STEPS = ("viewpoint_capture_1", "viewpoint_capture_2")
_STEEPEST_DEG = 65.0  # from the normal, at which a view still measures a surface
_OPENINGS_DEG = (90.0, 28.0)  # from the vertical: open ground, and a wound
_NORMALS = 1000


def protocol_shots(scene: Scene, views: int) -> list[Shot]:
    """The protocol's viewpoints that the arm reaches, or the `views` of them that together cover most directions.

    The choice knows nothing of the specimen: what is to be covered are the normals of the upper half of a sphere at
    the point that the viewpoints aim at, each on open ground and in a wound. A view sees a normal within
    _STEEPEST_DEG of it, if the view is within the wound's opening.
    """
    planned = plan(scene, "exvivo_spine", *_STEPS)
    shots = [Shot(f"{shot.station[-1]}_{k:03d}.jpg", shot.station, shot.q) for k, shot in enumerate(planned)]
    toward = np.array([scene.true_camera(shot.q, shot.station)[:3, 3] - SCENE_CENTRE_M for shot in shots])
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    level = toward @ _upper_normals().T > np.cos(np.radians(_STEEPEST_DEG))
    sees = np.hstack([level & (toward[:, 2:] > np.cos(np.radians(opening))) for opening in _OPENINGS_DEG])
    chosen = set(sparse_choice([shot.name for shot in shots], list(sees), views))
    return [shot for shot in shots if shot.name in chosen]


def protocol_scene(seed: int, width: int, views: int, cache: Path = CACHE) -> Path:
    """The folder of a scene rendered from `protocol_shots`."""
    return render_scene(seed, width, views, cache=cache, planned=protocol_shots, suffix="_protocol")


def _upper_normals() -> Array:
    """(_NORMALS, 3) unit vectors, evenly over the upper half of a sphere: a Fibonacci lattice."""
    k = np.arange(_NORMALS) + 0.5
    z, angle = k / _NORMALS, np.pi * (1 + np.sqrt(5)) * k
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)
