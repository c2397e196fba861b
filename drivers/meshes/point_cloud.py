"""Reads point clouds (PLY without faces, or text with x y z and optional normals or colours) into metres."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from drivers.errors import UnreadableFileError
from drivers.interfaces import Array
from drivers.meshes.mesh_file import METRES_PER_UNIT, PARSE_ERRORS, MeshUnit, credible_unit

TEXT_SUFFIXES = (".xyz", ".asc", ".pts", ".txt", ".csv")


@dataclass(frozen=True, slots=True)
class PointCloud:
    """Points without faces.

    Attributes:
        points_m: (N, 3).
        normals: (N, 3) unit vectors, or None if the file has none.
        unit: of the file.
        unit_evidence: how that unit was determined.
    """

    points_m: Array
    normals: Array | None
    unit: str
    unit_evidence: str


def is_point_cloud(path: Path) -> bool:
    """Whether a file holds points without faces, judged by its extension or its PLY header."""
    if path.suffix.lower() in TEXT_SUFFIXES:
        return True
    if path.suffix.lower() != ".ply":
        return False
    with path.open("rb") as stream:
        for line in stream:
            words = line.split()
            if words[:2] == [b"element", b"face"]:
                return words[2:3] == [b"0"]
            if words[:2] == [b"element", b"tristrips"]:
                return False  # a mesh, but of an unsupported kind
            if words[:1] == [b"end_header"]:
                return True
    return False


def read_point_cloud(path: Path, unit: MeshUnit = "auto") -> PointCloud:
    """Read a point cloud, in metres.

    A text file has one point per line: x y z, then an optional unit normal as the last three columns. Other columns
    are ignored. `unit` is that of the file; `auto` infers it from the size of the bounding box.

    Raises:
        UnreadableFileError: not a point cloud, coordinates that are not finite, or an implausible unit.
    """
    points, normals = parse_point_cloud(path)
    found, evidence = credible_unit(path, points, unit)
    return PointCloud(points * METRES_PER_UNIT[found], normals, found, evidence)


def parse_point_cloud(path: Path) -> tuple[Array, Array | None]:
    """Points (N, 3) in the file's unit, and unit normals (N, 3) or None; raises as `read_point_cloud` does."""
    try:
        points, normals = _text(path) if path.suffix.lower() in TEXT_SUFFIXES else _ply(path)
    except (OSError, *PARSE_ERRORS) as error:
        raise UnreadableFileError(
            f"the file cannot be parsed as a point cloud ({error})",
            where=str(path),
            remedy="Export points as PLY, or as text with x y z in each line",
        ) from error
    if len(points) < 3 or not np.isfinite(points).all():
        raise UnreadableFileError(
            "the file has no points, or some that are not finite", where=str(path), remedy="Export the scan again"
        )
    return points, normals


def _text(path: Path) -> tuple[Array, Array | None]:
    with path.open(encoding="utf-8-sig") as stream:
        first = stream.readline()
    separator = "," if "," in first else ";" if ";" in first else None
    # The first line can be a header, or only the number of points (.pts).
    words = first.replace(",", " ").replace(";", " ").split()
    skipped = 0 if len(words) >= 3 and _is_number(words[0]) else 1
    table = np.loadtxt(
        path, delimiter=separator, skiprows=skipped, ndmin=2, comments=("#", "//"), encoding="utf-8-sig"
    )
    if table.shape[1] < 3:
        raise ValueError(f"{table.shape[1]} columns")
    return np.ascontiguousarray(table[:, :3]), _unit_normals(table[:, -3:] if table.shape[1] >= 6 else None)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _ply(path: Path) -> tuple[Array, Array | None]:
    points, normals = ply_points(path)
    return points, _unit_normals(normals)


def ply_points(path: Path) -> tuple[Array, Array | None]:
    """The vertices (N, 3) of a PLY file as they are, also if not finite, and its normals (N, 3) or None.

    Raises OSError, or one of PARSE_ERRORS if the file is damaged.
    """
    import trimesh  # noqa: PLC0415 - half a second, for those who read a cloud

    with path.open("rb") as stream:
        loaded = cast("Any", trimesh.load(stream, file_type="ply", process=False))
    points = np.array(loaded.vertices, dtype=np.float64)
    raw = loaded.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    names = () if raw is None else raw.dtype.names if hasattr(raw, "dtype") else tuple(raw)
    if raw is None or not {"nx", "ny", "nz"} <= set(names or ()):
        return points, None
    return points, np.stack([np.asarray(raw[name], dtype=np.float64).ravel() for name in ("nx", "ny", "nz")], axis=1)


def _unit_normals(columns: Array | None) -> Array | None:
    """The columns (N, 3) as normals if nearly all are unit vectors; None if not (colours, intensities)."""
    if columns is None:
        return None
    length = np.linalg.norm(columns, axis=1)
    if not np.isfinite(length).all() or np.mean(np.abs(length - 1.0) < 0.05) < 0.99:
        return None
    return columns / np.maximum(length, 1e-300)[:, None]
