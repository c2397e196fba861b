"""A first surface, closed where nothing was matched, as a guess for the second search: Poisson reconstruction.

Source: Kazhdan and Hoppe, "Screened Poisson Surface Reconstruction", ACM Transactions on Graphics 2013; in COLMAP.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pycolmap
import trimesh

from service.compute.ground_truth.surface import Surface
from service.core.geometry import Array

_DEPTH = 9  # of the octree: cells of a 512th of the scene; a guess needs no more


def closed(surface: Surface) -> Surface:
    """A surface without holes near the given one; what it adds is a guess and never a result."""
    with tempfile.TemporaryDirectory(prefix="orthocapture-") as name:
        points, mesh = Path(name) / "points.ply", Path(name) / "mesh.ply"
        _write_points(points, surface.vertices_m, surface.vertex_normals)
        options = pycolmap.PoissonMeshingOptions(depth=_DEPTH, trim=0.0, num_threads=1)
        pycolmap.poisson_meshing(points, mesh, options)
        found = trimesh.load_mesh(mesh, process=False)
    return Surface(np.asarray(found.vertices, dtype=np.float64), np.asarray(found.faces, dtype=np.int64))


def _write_points(path: Path, points_m: Array, normals: Array) -> None:
    """Write points with normals as COLMAP reads them, which needs a colour as well."""
    names = ("x", "y", "z", "nx", "ny", "nz")
    colours = ("red", "green", "blue")
    rows = np.zeros(len(points_m), dtype=[(name, "<f4") for name in names] + [(name, "u1") for name in colours])
    for k, name in enumerate(names):
        rows[name] = np.concatenate([points_m, normals], axis=1)[:, k]
    fields = [f"property float {name}" for name in names] + [f"property uchar {name}" for name in colours]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *fields, "end_header", ""]
    path.write_bytes("\n".join(header).encode() + rows.tobytes())
