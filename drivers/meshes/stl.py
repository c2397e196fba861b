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
        # Names may hold any word, and numbers 1E-3.
        words = _NAMES.sub(b"", block.lower()).split()
        keys = np.array([word[:8] for word in words] or [b""], dtype="S8")
        at = np.flatnonzero(keys == b"vertex")
        if len(at) and at[-1] + 3 >= len(words):
            raise ValueError("its last vertex is cut short")
        values = numbers([words[place + k] for place in at.tolist() for k in (1, 2, 3)])
        points.append(values.reshape(-1, 3))
        ends.append(known + np.searchsorted(at, np.flatnonzero(keys == b"endloop")))
        known += len(at)
    counts = np.diff(np.concatenate([[0], *ends]))
    if counts.sum() != known:
        raise ValueError("it has vertices outside its facets")
    return _of_facets(np.concatenate(points), counts.astype(np.int64))


def _of_facets(
    corners: np.ndarray[tuple[int, ...], np.dtype[np.float64]],
    counts: np.ndarray[tuple[int, ...], np.dtype[np.int64]],
) -> RawMesh:
    return raw_mesh(corners, Polygons(np.arange(len(corners)), counts))
