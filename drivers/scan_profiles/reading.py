"""Reads an export as its scanner's profile says, and refuses one that is not of that kind."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drivers.errors import UnreadableFileError
from drivers.foreign_code import reading
from drivers.interfaces import Array, ScanExport, ScannedMesh
from drivers.meshes.mesh_file import MeshUnit, read_mesh_file, scanned_mesh, unchanged
from drivers.meshes.mesh_format import check_complete
from drivers.meshes.point_cloud import is_point_cloud, ply_points
from drivers.meshes.raw_mesh import IntArray, RawMesh
from drivers.scan_profiles.e57 import check_e57, read_e57
from drivers.scan_profiles.profile import ScanProfile
from drivers.scan_profiles.views import View, looks_along_z, view_mesh
from service.core.geometry import apply

_UNIT_LENGTH = 0.05  # tolerance of a normal's length


def check_export(profile: ScanProfile, path: Path) -> None:
    """Check that an export is complete. Raises as drivers.meshes.mesh_format.check_complete does."""
    if path.suffix.lower() == ".e57":
        check_e57(path)
    check_complete(path, points=bool(profile.views))


def read_export(profile: ScanProfile, export: ScanExport, unit: MeshUnit = "auto") -> ScannedMesh:
    """Read an export, in metres.

    Args:
        profile: the profile of the scanner that made it.
        export: the file and its companions.
        unit: the file's unit; `auto`: the profile's.

    Raises:
        IncompleteExportError: truncated, still growing or locked.
        UnreadableFileError: read_mesh_file raises it; points that are not in the order of the sensor's pixels; a view
            in another frame than the sensor's.
        DriverMissingError: an E57 file, and pye57 is not installed.
    """
    path = export.files[0]
    suffix = path.suffix.lower()
    if suffix not in profile.units:
        raise UnreadableFileError(
            f"{profile.software} does not export this kind of file ({suffix or 'no extension'})",
            where=str(path),
            remedy=profile.advice,
        )
    stated = profile.units[suffix] if unit == "auto" or suffix == ".e57" else unit
    if suffix != ".e57" and not (profile.views and is_point_cloud(path)):
        return read_mesh_file(path, stated, export=export)
    with unchanged(path):
        check_export(profile, path)
        vertices, faces, normals = _of_e57(path) if suffix == ".e57" else _of_view(profile, path)
    return scanned_mesh(RawMesh(vertices, faces, normals), stated, export)


def _of_e57(path: Path) -> tuple[Array, IntArray, None]:
    vertices: list[Array] = []
    faces: list[IntArray] = []
    for view, T_file_view in read_e57(path):
        own, triangles, _ = view_mesh(view)
        faces.append(triangles + sum(len(before) for before in vertices))
        vertices.append(apply(T_file_view, own))
    return _surface(path, np.concatenate(vertices), np.concatenate(faces)), np.concatenate(faces), None


def _of_view(profile: ScanProfile, path: Path) -> tuple[Array, IntArray, Array | None]:
    with reading(path, "PLY", profile.advice):
        points, normals = ply_points(path)
    shape = next(((rows, columns) for columns, rows in profile.views if rows * columns == len(points)), None)
    if shape is None:
        known = ", ".join(f"{columns} × {rows}" for columns, rows in profile.views)
        raise UnreadableFileError(
            f"its {len(points):,} points are not one for each pixel of a {profile.scanner} ({known}), so that there "
            "is no surface between them",
            where=str(path),
            remedy=profile.advice,
        )
    points = np.where((points == 0).all(axis=1)[:, None], np.nan, points)
    view = View(points.reshape(*shape, 3), None if normals is None else normals.reshape(*shape, 3))
    if not looks_along_z(view):
        raise UnreadableFileError(
            "its points do not lie in front of the sensor (z > 0): it was exported in another frame, or with an axis "
            "negated",
            where=str(path),
            remedy=profile.advice,
        )
    vertices, faces, kept = view_mesh(view)
    return _surface(path, vertices, faces), faces, _usable(kept)


def _surface(path: Path, vertices: Array, faces: IntArray) -> Array:
    """The vertices, unless there is no surface."""
    if len(faces) == 0:
        raise UnreadableFileError(
            "no neighbouring pixels were measured, so there is no surface",
            where=str(path),
            remedy="Scan again with a longer exposure, from closer, or with less glare",
        )
    return vertices


def _usable(normals: Array | None) -> Array | None:
    """The normals if nearly all are unit vectors, else None."""
    if normals is None:
        return None
    length = np.linalg.norm(normals, axis=1)
    return normals if np.mean(np.abs(length - 1.0) < _UNIT_LENGTH) > 0.99 else None
