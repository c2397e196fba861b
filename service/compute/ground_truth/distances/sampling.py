"""Points at an even density on a surface, the density being one point for each square of the spacing."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from service.compute.ground_truth.surface import IntArray, Surface
from service.core.errors import ComputeError
from service.core.geometry import Array
from service.core.units import mm

MOST_SAMPLES = 40_000_000  # of one surface; a score needs about 100 bytes for each
_CHUNK = 1_000_000


@dataclass(frozen=True, slots=True)
class Samples:
    """Points on a surface.

    Attributes:
        points_m: (N, 3).
        origin: (N,) index of the face that each point lies on, or of the cloud's point.
        normals: (N, 3) unit normals; None for a cloud without.
    """

    points_m: Array = field(repr=False)
    origin: IntArray = field(repr=False)
    normals: Array | None = field(repr=False)


def sample(surface: Surface, spacing_m: float, rng: np.random.Generator) -> Samples:
    """Sample a mesh at random, with one point per spacing²; thin a cloud to one point per cube of the spacing.

    Every face gets its share of the points, rounded up or down, at random places. The draws do not depend on the
    frame. A cloud that is sparser than the spacing stays as it is: points cannot be invented.

    Raises:
        ComputeError: the surface has no area, or would need more than MOST_SAMPLES points.
    """
    if not surface.is_mesh:
        return _thinned(surface, spacing_m)
    area = np.linalg.norm(surface.area_vectors_m2, axis=1)
    total = area.sum() / spacing_m**2
    if not total > 0:
        raise ComputeError("the mesh has no area", remedy="Export it again")
    if total > MOST_SAMPLES:
        raise ComputeError(
            f"{1e4 * area.sum():.0f} cm² at a spacing of {mm(spacing_m):g} mm are {total:.2g} points, more than "
            f"{MOST_SAMPLES:.0e}",
            remedy="Check the unit of the mesh, cut it to what is to be compared, or choose a larger spacing",
        )
    edges = np.floor(np.cumsum(area) / spacing_m**2 + rng.random()).astype(np.int64)
    origin = np.repeat(np.arange(len(area)), np.diff(edges, prepend=0))
    if len(origin) == 0:  # less than one cell of area
        origin = np.array([int(area.argmax())])
    points = np.empty((len(origin), 3))
    for begin in range(0, len(origin), _CHUNK):
        part = slice(begin, begin + _CHUNK)
        points[part] = random_places(surface, origin[part], rng)
    return Samples(points, origin, None)


def random_points(surface: Surface, n: int, rng: np.random.Generator) -> Array:
    """(n, 3) points of a mesh, independent of one another and uniform in area."""
    share = np.cumsum(np.linalg.norm(surface.area_vectors_m2, axis=1))
    chosen = np.searchsorted(share, rng.random(n) * share[-1], side="right")
    return random_places(surface, np.minimum(chosen, len(share) - 1), rng)


def normals_of(surface: Surface, samples: Samples, chosen: IntArray | slice) -> Array | None:
    """Unit normals (K, 3) of the chosen samples; None where the surface is a cloud without normals."""
    if surface.is_mesh:
        return surface.face_normals[samples.origin[chosen]]
    return None if samples.normals is None else samples.normals[chosen]


def random_places(surface: Surface, faces: IntArray, rng: np.random.Generator) -> Array:
    """(K, 3) one random point on each of these faces (K,)."""
    a, b, c = (surface.vertices_m[surface.faces[faces, k]] for k in range(3))
    u, v = rng.random((2, len(faces), 1))
    folded = u + v > 1
    u, v = np.where(folded, 1 - u, u), np.where(folded, 1 - v, v)
    return a + u * (b - a) + v * (c - a)


def _thinned(surface: Surface, spacing_m: float) -> Samples:
    points = surface.vertices_m
    if len(points) == 0:
        raise ComputeError("the point cloud has no points", remedy="Export it again")
    cells = np.floor((points - points.min(axis=0)) / spacing_m).astype(np.int64)
    extent = cells.max(axis=0) + 1
    key = (cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]
    kept = np.sort(np.unique(key, return_index=True)[1]).astype(np.int64)
    return Samples(points[kept], kept, None if surface.normals is None else surface.normals[kept])
