"""What a reader of a mesh file returns: triangles in the file's own unit, with what the file says of them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import Array
from drivers.meshes.polygons import cut

IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class RawMesh:
    """Triangles as a file has them.

    Attributes:
        vertices: (V, 3), in the file's unit.
        faces: (F, 3) indices of vertices.
        normals: (V, 3) of the vertices, None if the file has none, or not for each vertex of a face.
        colours: (V, 3), red, green and blue from 0 to 1, or None.
        texture_uv: (F, 3, 2) texture coordinates of the corners of the faces, or None.
        polygons_in_doubt: polygons that have no inside to speak of (drivers.meshes.polygons.Triangles.doubtful).
    """

    vertices: Array = field(repr=False)
    faces: IntArray = field(repr=False)
    normals: Array | None = field(default=None, repr=False)
    colours: Array | None = field(default=None, repr=False)
    texture_uv: Array | None = field(default=None, repr=False)
    polygons_in_doubt: int = 0


@dataclass(frozen=True, slots=True)
class Polygons:
    """Polygons as a file has them: `corners` (C,) are indices of vertices, `counts` (P,) how many each polygon has.

    `corner_normals` (C, 3) and `corner_uv` (C, 2) belong to the corners, and are None if not each has one.
    """

    corners: IntArray
    counts: IntArray
    corner_normals: Array | None = None
    corner_uv: Array | None = None


def raw_mesh(
    vertices: Array, polygons: Polygons, *, normals: Array | None = None, colours: Array | None = None
) -> RawMesh:
    """Cut polygons into triangles, and share out what belongs to their corners.

    Raises ValueError if a polygon refers to a vertex that is not there.
    """
    corners = polygons.corners
    if len(corners) and (corners.min() < 0 or corners.max() >= len(vertices)):
        wrong = int(corners.min() if corners.min() < 0 else corners.max())
        raise ValueError(f"a face refers to vertex {wrong} of {len(vertices)}")
    triangles = cut(vertices, corners, polygons.counts)
    if polygons.corner_normals is not None:
        normals = np.stack(
            [np.bincount(corners, axis, len(vertices)) for axis in polygons.corner_normals.T], axis=1
        ).astype(np.float64)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals /= np.where(length > 0, length, 1)
    uv = polygons.corner_uv
    return RawMesh(
        vertices,
        corners[triangles.at],
        normals,
        colours,
        None if uv is None else uv[triangles.at],
        triangles.doubtful,
    )
