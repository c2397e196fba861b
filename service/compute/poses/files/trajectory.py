"""Reads trajectories in TUM's form: a line `timestamp tx ty tz qx qy qz qw` for each image, without names."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from service.core.delimited_text import TextTable, is_number
from service.core.errors import DataError
from service.core.geometry import Transform, from_quaternion

_COLUMNS = 8
_UNIT = 1e-3  # tolerance of a quaternion's length from 1


def is_trajectory(table: TextTable) -> bool:
    """Whether a table has eight numbers in its first line, separated by spaces, and so no header and no names."""
    if not table.rows or table.dialect.separator != " ":
        return False
    cells = table.rows[0].cells
    return len(cells) == _COLUMNS and all(map(is_number, cells))


def trajectory_poses(table: TextTable, path: Path) -> dict[str, Transform]:
    """T_world_camera by timestamp, as the file writes it: images of such data sets are named by it.

    Raises:
        DataError: a line has another form, or a timestamp occurs twice; the message names file:line.
    """
    poses: dict[str, Transform] = {}
    for row in table.rows:
        where = f"{path}:{row.line}"
        if len(row.cells) != _COLUMNS or not all(map(is_number, row.cells)):
            raise DataError(
                "the line is not timestamp tx ty tz qx qy qz qw, as those before it",
                where=where,
                remedy="Correct the line",
            )
        stamp, *rest = row.cells
        values = np.array([float(cell) for cell in rest])
        length = float(np.linalg.norm(values[3:]))
        if not np.isfinite(values).all() or abs(length - 1) > _UNIT:
            raise DataError(
                f"the quaternion's length is {length:.4f}, not 1", where=where, remedy="Check the order qx qy qz qw"
            )
        if stamp in poses:
            raise DataError(f"timestamp {stamp} has two poses", where=where, remedy="Remove one of them")
        poses[stamp] = from_quaternion(values[:3], values[3:])
    return poses
