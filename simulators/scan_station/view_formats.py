"""Encodes views of a sensor: PLY with one point for each pixel, and E57 with rows and columns."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from simulators.geometry import Array
from simulators.scan_station.scanners import Scanner
from simulators.serve import SimulatorError


def view_ply(scanner: Scanner, points: Array, normals: Array) -> bytes:
    """A binary PLY of points (rows, columns, 3), NaN where nothing was measured, in the unit of the file."""
    fields = [(axis, "<f4") for axis in "xyz"]
    columns = list(np.where(np.isfinite(points), points, scanner.missing).reshape(-1, 3).T)
    if scanner.normals:
        fields += [(name, "<f4") for name in ("nx", "ny", "nz")]
        columns += list(np.nan_to_num(normals).reshape(-1, 3).T)
    if scanner.colours:
        grey = np.where(np.isfinite(points[..., 0]), 90 + 120 * np.nan_to_num(-normals[..., 2]), 0).ravel()
        fields += [(name, "u1") for name in ("red", "green", "blue", "alpha")]
        columns += [grey, grey, grey, np.full_like(grey, 255)]
    rows = np.empty(points.size // 3, dtype=fields)
    for (name, _), column in zip(fields, columns, strict=True):
        rows[name] = column
    kinds = {"<f4": "float", "u1": "uchar"}
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    head += [f"property {kinds[kind]} {name}" for name, kind in fields]
    return "\n".join([*head, "end_header", ""]).encode() + rows.tobytes()


def e57(views: Sequence[tuple[Array, Array]]) -> bytes:
    """An E57 file of structured scans: points (rows, columns, 3) in metres, and T_file_view (4, 4), of each.

    Raises SimulatorError without the package pye57, which is optional.
    """
    try:
        import pye57  # noqa: PLC0415 - optional, and it loads a native library
    except ImportError as error:
        raise SimulatorError("exporting E57 needs the package pye57: install orthocapture[e57]") from error
    with tempfile.TemporaryDirectory(prefix="orthocapture-e57-") as folder:
        path = Path(folder) / "scan.e57"
        file: Any = pye57.E57(str(path), mode="w")
        for points, T_file_view in views:
            measured = np.isfinite(points).all(axis=-1)
            row, column = np.nonzero(measured)
            x, y, z = points[measured].T
            x_y_z_w = Rotation.from_matrix(T_file_view[:3, :3]).as_quat()
            file.write_scan_raw(
                {"cartesianX": x, "cartesianY": y, "cartesianZ": z, "rowIndex": row, "columnIndex": column},
                rotation=np.roll(x_y_z_w, 1),
                translation=T_file_view[:3, 3],
            )
        file.close()
        return path.read_bytes()
