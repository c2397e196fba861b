"""If a mesh has no sphere of the given radius: the radius that its spheres do have."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.compute.surfaces.spheres.mesh_spheres import MeshSphere, SphereLimits, locate_spheres
from service.core.errors import ComputeError
from service.core.geometry import Array

# A search finds radii within 4 %. Half and twice: radius and diameter were confused.
_TRIED = (0.95, 1.05, 0.9, 1.1, 0.85, 1.15, 0.8, 1.2, 0.75, 1.25, 0.7, 1.3, 0.5, 2.0)
_LEAST_COVERAGE = 0.15  # of a sphere; smaller caps of any radius occur everywhere


@dataclass(frozen=True, slots=True)
class MeasuredRadius:
    """The radius of the spheres in a mesh, and those spheres."""

    radius_m: float
    spheres: tuple[MeshSphere, ...]


def seen_radius(
    vertices_m: Array,
    faces: NDArray[np.integer],
    radius_m: float,
    limits: SphereLimits | None = None,
    *,
    normals: Array | None = None,
) -> MeasuredRadius | None:
    """The radius with the most spheres in the mesh: from 0.7 to 1.3 times `radius_m`, half or twice it.

    Takes as long as a dozen searches. Arguments as for `locate_spheres`; None if there are no such spheres.

    Raises:
        DataError: as `locate_spheres`.
    """
    best: tuple[MeshSphere, ...] = ()
    nearest = radius_m
    for factor in _TRIED:
        found = _located(vertices_m, faces, factor * radius_m, limits, normals)
        if _worth(found) > _worth(best):
            best, nearest = found, factor * radius_m
    if not best:
        return None
    for _ in range(2):  # the residual at a nearly correct radius is nearly the whole difference
        nearest = nearest + float(np.median([sphere.radius_residual_m for sphere in best]))
        again = _located(vertices_m, faces, nearest, limits, normals)
        best = again if len(again) >= len(best) else best
    return MeasuredRadius(nearest, best)


def _located(
    vertices_m: Array, faces: NDArray[np.integer], radius_m: float, limits: SphereLimits | None, normals: Array | None
) -> tuple[MeshSphere, ...]:
    try:
        found = locate_spheres(vertices_m, faces, radius_m, None, limits, normals=normals)
    except ComputeError:
        return ()
    return tuple(sphere for sphere in found if sphere.coverage > _LEAST_COVERAGE)


def _worth(spheres: tuple[MeshSphere, ...]) -> tuple[int, float]:
    return len(spheres), sum(sphere.coverage for sphere in spheres)
