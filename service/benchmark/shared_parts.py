"""What several methods share: where they leave their meshes, and the triangulation that some begin with."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, Field, FiniteFloat, ValidationError

from service.benchmark.method import Command, Workplace
from service.core.errors import DataError
from service.core.geometry import Array

_Axis = Annotated[int, Field(ge=0, le=2)]


def at(name: str) -> Callable[[Workplace], Path]:
    """A mesh of this name in the method's folder."""
    return newest(name)


def newest(pattern: str) -> Callable[[Workplace], Path]:
    """The youngest of the files in the method's folder that match a pattern."""

    def find(place: Workplace) -> Path:
        found = [path for path in place.work.glob(pattern) if path.is_file()]
        if not found:
            raise DataError(
                "the method ended without a mesh", where=str(place.work / pattern), remedy="Read its output"
            )
        return max(found, key=lambda path: path.stat().st_mtime_ns)

    return find


class _UnitBox(BaseModel):
    """What is read of it."""

    mesh_axes: tuple[_Axis, _Axis, _Axis]
    centre_m: tuple[FiniteFloat, FiniteFloat, FiniteFloat]


def from_unit_box(vertices: Array, data: Path) -> Array:
    """World points (N, 3), in metres, of a mesh that was made from an export with `unit_box.json` in its folder.

    Raises:
        DataError: the file is not what the export wrote.
    """
    path = data / "unit_box.json"
    try:
        box = _UnitBox.model_validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        raise DataError(
            "the extent of the scene cannot be read", where=str(path), remedy="Export it again"
        ) from error
    return vertices[:, box.mesh_axes] + np.array(box.centre_m)


def triangulation(place: Workplace, dense: Path) -> Command:
    """The command of ours that makes COLMAP's workspace `dense` of the export `colmap-pinhole` in `place.data`."""
    return (place.python, "-m", "service.benchmark.programs.triangulated", str(place.data), str(dense))
