"""Reads STL files, binary and ASCII, whatever the ASCII ones are named and however they are written."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from drivers.meshes.foreign_text import logical_lines, numbers
from drivers.meshes.raw_mesh import Polygons, RawMesh, raw_mesh

_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_NAMES = re.compile(rb"^(?:end)?solid\b[^\n]*", re.MULTILINE)
_HEADER_BYTES = 84


def announced_bytes(head: bytes) -> int | None:
    """The size of a binary STL that begins so; None if it is too short to tell."""
    return None if len(head) < _HEADER_BYTES else _HEADER_BYTES + 50 * int.from_bytes(head[80:84], "little")


def read_stl(path: Path) -> RawMesh:
    """Read an STL. Facets of an ASCII file may have more than three corners.

    Raises:
        ValueError: it is neither.
        OSError: the file cannot be read.
    """
    with path.open("rb") as stream:
        head = stream.read(_HEADER_BYTES)
        # A binary file may begin with "solid" too, so the size decides.
        if announced_bytes(head) == path.stat().st_size:
            corners = np.fromfile(stream, dtype=_FACET)["corners"].reshape(-1, 3).astype(np.float64)
            return _of_facets(corners, np.full(len(corners) // 3, 3, dtype=np.int64))
    points, ends, known = [np.empty((0, 3))], [np.empty(0, np.int64)], 0
    for block in logical_lines(path):
        # Names may hold any word; the words of the format may be in capitals, and all in one line.
        words = _NAMES.sub(b"", block.lower()).replace(b"vertex", b"\nv").replace(b"endloop", b"\n!\n")
        text = np.frombuffer(words + b"\n", dtype=np.uint8).copy()
        line_ends = np.flatnonzero(text == ord("\n"))
        starts = np.concatenate([[0], line_ends[:-1] + 1])
        is_vertex, is_end = text[starts] == ord("v"), text[starts] == ord("!")
        text[starts[is_vertex]] = ord(" ")
        values = numbers(text[np.repeat(is_vertex, line_ends - starts + 1)].tobytes())
        if len(values) != 3 * np.count_nonzero(is_vertex):
            raise ValueError("a vertex has more or fewer than three numbers")
        points.append(values.reshape(-1, 3))
        ends.append(known + np.cumsum(is_vertex)[is_end])
        known += int(is_vertex.sum())
    counts = np.diff(np.concatenate([[0], *ends]))
    if counts.sum() != known:
        raise ValueError("it has vertices outside its facets")
    return _of_facets(np.concatenate(points), counts.astype(np.int64))


def _of_facets(
    corners: np.ndarray[tuple[int, ...], np.dtype[np.float64]],
    counts: np.ndarray[tuple[int, ...], np.dtype[np.int64]],
) -> RawMesh:
    return raw_mesh(corners, Polygons(np.arange(len(corners)), counts))
