"""Reads OFF files, whose faces are polygons of any number of corners."""

from __future__ import annotations

import re
from itertools import islice
from pathlib import Path

import numpy as np

from drivers.meshes.foreign_text import logical_lines, numbers
from drivers.meshes.raw_mesh import Polygons, RawMesh, raw_mesh

_HEAD = re.compile(rb"(?:ST)?C?N?OFF\b", re.IGNORECASE)


def read_off(path: Path) -> RawMesh:
    """Read an OFF in text form; the first three columns of its vertices are their coordinates.

    Raises:
        ValueError: it is no such file, or ends before all that it announces.
        OSError: the file cannot be read.
    """
    lines = (row for block in logical_lines(path) for line in block.split(b"\n") if (row := line.partition(b"#")[0]))
    rows = (row.strip() for row in lines if row.strip())
    first = next(rows, b"")
    head = _HEAD.match(first)
    if head is None:
        raise ValueError("it does not begin with OFF")
    if first[head.end() :].strip().upper() == b"BINARY":
        raise ValueError("it is a binary OFF, which is not supported")
    counts = first[head.end() :].split() or next(rows, b"").split()
    n_vertices, n_faces = numbers(b" ".join(counts[:2]), np.int64).tolist()
    table = [row.split()[:3] for row in islice(rows, n_vertices)]
    faces = [row.split() for row in islice(rows, n_faces)]
    if len(table) < n_vertices or len(faces) < n_faces or any(len(row) < 3 for row in table):
        raise ValueError("it is shorter than it announces")
    sizes = numbers(b" ".join(row[0] for row in faces), np.int64)
    if any(len(row) <= size for row, size in zip(faces, sizes.tolist(), strict=True)):
        raise ValueError("a face has fewer corners than it announces")
    corners = b" ".join(word for row, size in zip(faces, sizes.tolist(), strict=True) for word in row[1 : 1 + size])
    points = b" ".join(word for row in table for word in row)
    return raw_mesh(numbers(points).reshape(-1, 3), Polygons(numbers(corners, np.int64), sizes))
