"""Reads the structured scans of an E57 file (ASTM E2807) as views, with the optional package pye57."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import DriverMissingError, IncompleteExportError, UnreadableFileError
from drivers.foreign_code import reading
from drivers.interfaces import Array
from drivers.scan_profiles.views import View

_SIGNATURE = b"ASTM-E57"
_MOST_PIXELS = 100_000_000  # of a view; the largest sensors have half as many
_AXES = ("cartesianX", "cartesianY", "cartesianZ")


def check_e57(path: Path) -> None:
    """Check that an E57 file is complete, from the length that its header states.

    Raises IncompleteExportError, UnreadableFileError if it is not an E57 file, and OSError.
    """
    with path.open("rb") as file:
        head = file.read(48)
    if head and not head.startswith(_SIGNATURE[: len(head)]):
        raise UnreadableFileError(
            "it does not begin like an E57 file", where=str(path), remedy="Export the scan again as E57"
        )
    size = path.stat().st_size
    stated = struct.unpack("<Q", head[16:24])[0] if len(head) == 48 else 48
    if size < stated:
        raise IncompleteExportError(
            f"the file is cut short: {size} bytes of {stated} that its header announces",
            where=str(path),
            remedy="Wait until the export has finished; if it has, export the scan again",
        )


def read_e57(path: Path) -> tuple[tuple[View, Array], ...]:
    """The views of a file and, for each, T_file_view (4, 4), metres.

    Raises:
        DriverMissingError: pye57 is not installed.
        UnreadableFileError: damaged, no scan in it, or a scan that does not state rows and columns.
    """
    try:
        import pye57  # noqa: PLC0415 - optional, and it loads a native library
    except ImportError as error:
        raise DriverMissingError(
            "E57 files need the package pye57, which is not installed",
            where=str(path),
            remedy="Install orthocapture[e57], or export the scan as a mesh (PLY, OBJ or STL)",
        ) from error

    with reading(path, "E57", "Export the scan again"):
        file = pye57.E57(str(path))
        try:
            views = tuple(_view(path, file, index) for index in range(file.scan_count))
        finally:
            file.close()
    if not views:
        raise UnreadableFileError("the file has no scans", where=str(path), remedy="Export the scan again as E57")
    return views


def _view(path: Path, file: Any, index: int) -> tuple[View, Array]:
    header = file.get_header(index)
    if header.point_count > _MOST_PIXELS:
        raise UnreadableFileError(
            f"scan {index} has {header.point_count:,} points, more than any sensor",
            where=str(path),
            remedy="Export fewer points, or a mesh",
        )
    data: Mapping[str, Any] = file.read_scan_raw(index)
    if "rowIndex" not in data or "columnIndex" not in data:
        raise UnreadableFileError(
            f"scan {index} has only points, without rows and columns, so no surface",
            where=str(path),
            remedy="Export structured scans (with rows and columns), or a triangle mesh",
        )
    row, column = (np.asarray(data[name], dtype=np.int64) for name in ("rowIndex", "columnIndex"))
    row, column = row - row.min(), column - column.min()
    shape = (int(row.max()) + 1, int(column.max()) + 1)
    if shape[0] * shape[1] > _MOST_PIXELS:
        raise UnreadableFileError(
            f"scan {index} states {shape[1]} columns and {shape[0]} rows, more than any sensor",
            where=str(path),
            remedy="The file is damaged: export the scan again",
        )
    points = np.full((*shape, 3), np.nan)
    measured = np.ones(len(row), dtype=bool)
    if "cartesianInvalidState" in data:
        measured = np.asarray(data["cartesianInvalidState"]) == 0
    xyz = np.stack([np.asarray(data[name], dtype=np.float64) for name in _AXES], axis=1)
    points[row[measured], column[measured]] = xyz[measured]
    T_file_view = np.eye(4)
    if header.has_pose():
        T_file_view[:3, :3], T_file_view[:3, 3] = header.rotation_matrix, header.translation
    return View(points, None), T_file_view
