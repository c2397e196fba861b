"""If the spheres are missing in a mesh: whether it was read in the wrong unit, judged by their known radius."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.compute.surfaces.spheres.mesh_spheres import locate_spheres
from service.core.errors import ComputeError
from service.core.geometry import Array
from service.core.units import MISTAKEN_LENGTHS

_SCENE_M = (0.1, 3.0)  # diagonal of a scene with its spheres
_LEAST_SPHERES = 3
_LEAST_COVERAGE = 0.15  # of a sphere; smaller caps of any radius occur everywhere


@dataclass(frozen=True, slots=True)
class WrongUnit:
    """A mistaken unit that makes the spheres have their radius, with the coordinates multiplied by `factor`."""

    factor: float
    words: str
    spheres: int


def wrong_unit(vertices_m: Array, faces: NDArray[np.integer], radius_m: float) -> WrongUnit | None:
    """The mistaken unit with the most spheres of the known radius.

    Only those are tried that give the mesh the size of a scene, so that a mesh of that size takes no time.

    Args:
        vertices_m: (V, 3) as they were read.
        faces: (F, 3).
        radius_m: of the spheres.

    Returns:
        the mistake, or None if no other unit shows three spheres.
    """
    diagonal_m = float(np.linalg.norm(np.ptp(vertices_m, axis=0)))
    low, high = _SCENE_M
    if low <= diagonal_m <= high:
        return None
    best: WrongUnit | None = None
    for words, factor in MISTAKEN_LENGTHS.items():
        if not low <= factor * diagonal_m <= high:
            continue
        try:
            found = locate_spheres(factor * vertices_m, faces, radius_m, None)
        except ComputeError:
            continue
        count = sum(sphere.coverage > _LEAST_COVERAGE for sphere in found)
        if count >= _LEAST_SPHERES and (best is None or count > best.spheres):
            best = WrongUnit(factor, words, count)
    return best
