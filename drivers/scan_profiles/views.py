"""Turns a view, one point for each pixel of its sensor, into a triangle mesh."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import Array

# Triangles seen at a more grazing angle bridge a step in depth, or are mostly noise.
_MOST_GRAZING_DEG = 80.0


@dataclass(frozen=True, slots=True)
class View:
    """One view in its own frame: the sensor at the origin, looking along +z.

    Attributes:
        points: (rows, columns, 3), not finite where nothing was measured.
        normals: (rows, columns, 3), or None if the file has none.
    """

    points: Array = field(repr=False)
    normals: Array | None = field(repr=False)


def view_mesh(view: View) -> tuple[Array, NDArray[np.int64], Array | None]:
    """Triangles between neighbouring pixels, facing the sensor.

    A triangle is left out if a corner was not measured, or if the angle between its normal and the line of sight is
    above 80°: there the surface has a step, and nothing was measured between its edges.

    Returns:
        vertices (V, 3), all of them measured and part of a triangle; faces (F, 3); and the file's normals (V, 3) or
        None.
    """
    rows, columns, _ = view.points.shape
    points = view.points.reshape(-1, 3)
    measured = np.asarray(np.isfinite(points).all(axis=1))
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = np.concatenate([np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)])
    faces = faces[measured[faces].all(axis=1)]
    corners = points[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sight = corners.mean(axis=1)
    along = np.sum(normal * sight, axis=1)
    least = np.cos(np.deg2rad(_MOST_GRAZING_DEG))
    kept = np.abs(along) > least * np.linalg.norm(normal, axis=1) * np.linalg.norm(sight, axis=1)
    faces = np.where((along > 0)[:, None], faces[:, ::-1], faces)[kept]
    used, compact = np.unique(faces, return_inverse=True)
    normals = None if view.normals is None else view.normals.reshape(-1, 3)[used]
    return points[used], compact.reshape(-1, 3).astype(np.int64), normals


def looks_along_z(view: View) -> bool:
    """Return whether the points lie in front of the sensor; if not, another frame or a mirrored axis was exported."""
    z = view.points[..., 2]
    z = z[np.isfinite(z)]
    return len(z) > 0 and float(np.mean(z > 0)) > 0.99
