"""Figures of a mesh file as it is imported, which can be derived by hand for a body of known size."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drivers.meshes.mesh_file import read_mesh_file
from service.core.geometry import Array
from service.core.units import mm

# A box of 300 × 200 × 100 mm: its corners, and its faces as seen from outside, anticlockwise.
BOX_MM = np.array([[x, y, z] for z in (0.0, 100.0) for y in (0.0, 200.0) for x in (0.0, 300.0)])
BOX_FACES = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (1, 3, 7, 5), (3, 2, 6, 7), (2, 0, 4, 6))
BOX_AREA_MM2, BOX_VOLUME_MM3 = 2 * (300 * 200 + 300 * 100 + 200 * 100), 300 * 200 * 100
# An L of 300 × 300 mm whose arms are 110 mm wide: 300² − 190² mm².
L_MM = np.array([[0.0, 0, 0], [300, 0, 0], [300, 110, 0], [110, 110, 0], [110, 300, 0], [0, 300, 0]])
L_AREA_MM2 = 53_900.0


def area_mm2(path: Path) -> float:
    """The sum of the areas of the triangles of a mesh file in millimetres."""
    return float(np.linalg.norm(_crosses_mm2(path), axis=1).sum() / 2)


def volume_mm3(path: Path) -> float:
    """The volume within a closed mesh file in millimetres: above 0 if its faces wind as seen from outside."""
    corners, _ = _corners_mm(path)
    return float(np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6)


def area_vector_mm2(path: Path) -> Array:
    """The sum of the area vectors of the triangles, (3,): for a flat mesh of one winding as long as its area."""
    return _crosses_mm2(path).sum(axis=0) / 2


def _crosses_mm2(path: Path) -> Array:
    corners, _ = _corners_mm(path)
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _corners_mm(path: Path) -> tuple[Array, int]:
    mesh = read_mesh_file(path, "mm").mesh
    return mm(mesh.vertices_m)[mesh.faces], len(mesh.faces)
