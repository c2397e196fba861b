"""Reads point clouds (PLY without faces, or text with x y z and optional normals or colours) into metres."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivers.errors import DeviceError, UnreadableFileError
from drivers.foreign_code import reading
from drivers.interfaces import Array
from drivers.meshes.foreign_text import is_number, logical_lines, readings
from drivers.meshes.mesh_file import METRES_PER_UNIT, MeshUnit, credible_unit
from drivers.meshes.ply import Rows, read_header, read_rows

_SAMPLE_BYTES = 64 * 1024
_DECIMAL_COMMA = re.compile(rb"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
TEXT_SUFFIXES = (".xyz", ".asc", ".pts", ".txt", ".csv")


@dataclass(frozen=True, slots=True)
class PointCloud:
    """Points without faces.

    Attributes:
        points_m: (N, 3).
        normals: (N, 3) unit vectors, or None if the file has none.
        unit: the file's unit.
        unit_evidence: how that unit was determined.
    """

    points_m: Array
    normals: Array | None
    unit: str
    unit_evidence: str


def is_point_cloud(path: Path) -> bool:
    """Return whether a file holds points without faces, judged by its extension or its PLY header."""
    if path.suffix.lower() in TEXT_SUFFIXES:
        return True
    if path.suffix.lower() != ".ply":
        return False
    try:
        header = read_header(path)
    except DeviceError:  # reading it as a mesh says what is wrong
        return False
    return not header.count("face") and not any(element.name == "tristrips" for element in header.elements)


def read_point_cloud(path: Path, unit: MeshUnit = "auto", *, any_size: bool = False) -> PointCloud:
    """Read a point cloud, in metres.

    A text file has one point per line: x y z, then an optional unit normal as the last three columns. Other columns
    are ignored. Numbers may be separated by blanks, commas or semicolons, and have decimal commas where these cannot
    be taken for separators. `unit` is that of the file; `auto` infers it from the size of the bounding box,
    with `any_size` as `credible_unit` takes it.

    Raises:
        UnreadableFileError: not a point cloud, coordinates that are not finite, or an implausible unit.
    """
    points, normals = parse_point_cloud(path)
    found, evidence = credible_unit(path, points, unit, any_size=any_size)
    return PointCloud(points * METRES_PER_UNIT[found], normals, found, evidence)


def parse_point_cloud(path: Path) -> tuple[Array, Array | None]:
    """Points (N, 3) in the file's unit, and unit normals (N, 3) or None; raises as `read_point_cloud` does."""
    remedy = "Export points as PLY, or as text with x y z in each line and decimal points"
    try:
        with reading(path, "a point cloud", remedy):
            points, normals = _text(path) if path.suffix.lower() in TEXT_SUFFIXES else _ply(path)
    except OSError as error:
        raise UnreadableFileError(
            f"the file cannot be opened ({error.strerror})", where=str(path), remedy="Check its permissions"
        ) from error
    if len(points) < 3 or not np.isfinite(points).all():
        raise UnreadableFileError(
            "the file has no points, or some that are not finite", where=str(path), remedy="Export the scan again"
        )
    return points, normals


def _text(path: Path) -> tuple[Array, Array | None]:
    """Read text with a point in each line. Raises ValueError if it cannot be, or may be read in two ways."""
    form = _form(next(logical_lines(path), b""))
    table = np.loadtxt(_plain_lines(path, form), ndmin=2)
    if table.shape[1] < 3:
        raise ValueError(f"{table.shape[1]} columns")
    whole = not form.points and form.separator == b"," and bool((table == np.rint(table)).all())
    if whole and table.shape[1] >= 6 and table.shape[1] % 2 == 0:
        raise ValueError("its commas may separate whole numbers, or be decimal commas: separate the numbers by ;")
    return np.ascontiguousarray(table[:, :3]), _unit_normals(table[:, -3:] if table.shape[1] >= 6 else None)


@dataclass(frozen=True, slots=True)
class _Form:
    """How a text writes numbers: what separates them besides blanks, and whether it has decimal commas or points."""

    separator: bytes
    commas: bool
    points: bool


def _form(block: bytes) -> _Form:
    rows = map(_without_remark, _without_quotes(block[:_SAMPLE_BYTES]).split(b"\n"))
    lines = [row for row in rows if re.match(rb"[-+.,]?\d", row)]
    if any(b";" in line for line in lines):
        separator, commas = b";", any(b"," in line for line in lines)
    else:
        words = [line.split() for line in lines]
        commas = any(len(row) >= 3 and any(_DECIMAL_COMMA.fullmatch(word) for word in row) for row in words)
        separator = b"," if not commas and any(b"," in line for line in lines) else b""
    return _Form(separator, commas, any(b"." in line for line in lines))


def _plain_lines(path: Path, form: _Form) -> Iterator[str]:
    """The lines with a point each, their numbers separated by blanks and with decimal points. Raises ValueError."""
    first = True
    for block in logical_lines(path):
        for line in _without_quotes(block).split(b"\n"):
            row = _without_remark(line)
            # The first line can be a header, or only the number of points (.pts).
            header, first = first and bool(row), first and not row
            words = row.replace(b",", b" ").replace(b";", b" ").split()
            if not row or (header and not (len(words) >= 3 and is_number(words[0]))):
                continue
            if form.separator and (row := row.rstrip(form.separator + b" ")):
                if b"" in map(bytes.strip, row.split(form.separator)):
                    raise ValueError("a line has an empty field")
                row = row.replace(form.separator, b" ")
            if form.commas and b"." in row:
                raise ValueError(f"it has decimal points and decimal commas, as in {readings(row)[0]!r}")
            yield (row.replace(b",", b".") if form.commas else row).decode("latin-1")


def _without_remark(line: bytes) -> bytes:
    return (re.split(rb"#|//", line, maxsplit=1)[0] if b"#" in line or b"//" in line else line).strip()


def _without_quotes(block: bytes) -> bytes:
    """Text as a table that has no quotes: "1,5","2,5" is 1,5;2,5."""
    return re.sub(rb'" *, *"', b";", block).replace(b'"', b"") if b'"' in block else block


def _ply(path: Path) -> tuple[Array, Array | None]:
    points, normals = ply_points(path)
    return points, _unit_normals(normals)


def ply_points(path: Path) -> tuple[Array, Array | None]:
    """The vertices (N, 3) of a PLY file as they are, also if not finite, and its normals (N, 3) or None.

    Raises ValueError if the file is damaged, OSError, and as read_rows does.
    """
    vertex = read_rows(path).get("vertex", Rows({}, {}))
    points = vertex.table("x", "y", "z")
    if points is None:
        raise ValueError("it has no vertices with x, y and z")
    return points, vertex.table("nx", "ny", "nz")


def _unit_normals(columns: Array | None) -> Array | None:
    """The columns (N, 3) as normals if nearly all are unit vectors; None if not (colours, intensities)."""
    if columns is None:
        return None
    length = np.linalg.norm(columns, axis=1)
    if not np.isfinite(length).all() or np.mean(np.abs(length - 1.0) < 0.05) < 0.99:
        return None
    return columns / np.maximum(length, 1e-300)[:, None]
