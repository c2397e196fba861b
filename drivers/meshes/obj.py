"""Reads OBJ files, with polygons of any number of corners, whatever their writer makes of blanks and line ends."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.interfaces import Array
from drivers.meshes.foreign_text import is_number, logical_lines, numbers
from drivers.meshes.raw_mesh import IntArray, Polygons, RawMesh, raw_mesh

_KINDS = (b"v ", b"vt", b"vn", b"f ")
_V, _VT, _VN, _F = range(4)
_NEWLINE, _BLANK, _SLASH, _HASH = b"\n /#"
_LEAST = {_V: 3, _VT: 1, _VN: 3}  # numbers in a line; a texture may have one dimension


@dataclass
class _Collected:
    """Holds what was read so far: for each kind of line the parts of its table, and how many rows they have."""

    parts: dict[int, list[Array]] = field(default_factory=lambda: {_V: [], _VT: [], _VN: []})
    rows: dict[int, int] = field(default_factory=lambda: {_V: 0, _VT: 0, _VN: 0})
    corners: list[IntArray] = field(default_factory=list[IntArray])  # (C, 3): vertex, texture, normal; -1: none
    counts: list[IntArray] = field(default_factory=list[IntArray])
    lines: int = 0

    def table(self, kind: int, columns: int) -> Array | None:
        """The first columns of a kind's lines; None if some lack them."""
        parts = [part[:, :columns] for part in self.parts[kind]]
        whole = parts and all(part.shape[1] == columns and np.isfinite(part).all() for part in parts)
        return np.concatenate(parts) if whole else None


def read_obj(path: Path) -> RawMesh:
    """Read the polygons of an OBJ; lines, points, groups and curves are left out.

    Raises:
        ValueError: a line cannot be understood; it says which one.
        OSError: the file cannot be read.
    """
    read = _Collected()
    for block in logical_lines(path):
        _read_block(block, read)
    vertices = [part[:, :3] for part in read.parts[_V]]
    corners = np.concatenate([np.empty((0, 3), np.int64), *read.corners])
    counts = np.concatenate([np.empty(0, np.int64), *read.counts])
    colours = [part[:, -3:] for part in read.parts[_V]]
    coloured = colours and all(part.shape[1] in {6, 7} for part in read.parts[_V])
    polygons = Polygons(
        corners[:, 0],
        counts,
        _of_corners(read.table(_VN, 3), corners[:, 2]),
        _of_corners(read.table(_VT, 2), corners[:, 1]),
    )
    points = np.concatenate([np.empty((0, 3)), *vertices])
    return raw_mesh(points, polygons, colours=np.concatenate(colours) if coloured else None)


def _of_corners(table: Array | None, index: IntArray) -> Array | None:
    """The row of a table for each corner; None if a corner has none."""
    if table is None or len(index) == 0 or index.min() < 0 or index.max() >= len(table):
        return None
    return table[index]


@dataclass(frozen=True)
class _Lines:
    """The lines of one kind in a block, without their keywords."""

    text: NDArray[np.uint8] = field(repr=False)
    ends: IntArray  # (L,) where they end in `text`
    numbers: IntArray  # (L,) of the lines in the file, from 1

    def per_line(self, begins: NDArray[np.bool_]) -> IntArray:
        """How many of what begins at these places each line has, (L,)."""
        return np.diff(np.concatenate([[0], np.cumsum(begins)[self.ends]]))

    def begins(self, *separators: int) -> NDArray[np.bool_]:
        """Return where words begin that these characters separate."""
        apart = np.isin(self.text, separators)
        begins = ~apart
        begins[1:] &= apart[:-1]
        return begins

    def values(self, per_line: IntArray, kind: type[np.float64] | type[np.int64]) -> Array:
        """All words as numbers; `per_line` says how many each line has. Raises ValueError with the line's number."""
        text = self.text.tobytes()
        try:
            return numbers(text, kind, int(per_line.sum()))
        except ValueError as error:
            words = enumerate(text.split())
            wrong = next((place for place, word in words if not is_number(word, kind)), 0)
            line = self.numbers[np.searchsorted(np.cumsum(per_line), wrong, side="right")]
            raise ValueError(f"line {line}: {error}") from None


def _read_block(block: bytes, read: _Collected) -> None:
    """Read whole lines, as logical_lines yields them. Raises ValueError with the line's number."""
    text = np.frombuffer(block, dtype=np.uint8)
    ends = np.flatnonzero(text == _NEWLINE)
    starts = np.concatenate([[0], ends[:-1] + 1])
    line_kind = np.full(len(starts), -1, dtype=np.int8)
    first, second = text[starts], text[np.minimum(starts + 1, ends)]
    for kind, (a, b) in enumerate(_KINDS):
        line_kind[(first == a) & (second == b)] = kind
    text = text.copy()
    if b"#" in block:
        text[_comments(text, starts, ends)] = _BLANK
    text[starts[line_kind >= 0]] = _BLANK
    text[starts[(line_kind == _VT) | (line_kind == _VN)] + 1] = _BLANK
    kinds = np.repeat(line_kind, ends - starts + 1)

    def lines_of(kind: int) -> _Lines:
        own = text[kinds == kind]
        return _Lines(own, np.flatnonzero(own == _NEWLINE), read.lines + 1 + np.flatnonzero(line_kind == kind))

    faces = np.flatnonzero(line_kind == _F)
    known = np.stack([read.rows[kind] + np.cumsum(line_kind == kind)[faces] for kind in (_V, _VT, _VN)], axis=1)
    for kind in _LEAST:
        _read_table(lines_of(kind), kind, read)
    _read_faces(lines_of(_F), known, read)
    read.lines += len(starts)


def _comments(text: NDArray[np.uint8], starts: IntArray, ends: IntArray) -> NDArray[np.bool_]:
    """Return where comments are: from each `#` to the end of its line."""
    hashes = np.flatnonzero(text == _HASH)
    lines, at = np.unique(np.searchsorted(starts, hashes, side="right") - 1, return_index=True)
    change = np.zeros(len(text) + 1, dtype=np.int8)
    change[hashes[at]] = 1
    change[ends[lines]] = -1
    return np.cumsum(change[:-1], dtype=np.int8) > 0


def _read_table(lines: _Lines, kind: int, read: _Collected) -> None:
    """Read the lines `v`, `vt` or `vn`."""
    if len(lines.numbers) == 0:
        return
    per_line = lines.per_line(lines.begins(_BLANK, _NEWLINE))
    values = lines.values(per_line, np.float64)
    least = int(per_line.min())
    if least < _LEAST[kind]:
        line = lines.numbers[per_line.argmin()]
        raise ValueError(f"line {line}: {least} numbers in a line of {_LEAST[kind]}")
    at = np.cumsum(per_line) - per_line
    columns = least if least < per_line.max() else int(per_line[0])
    read.parts[kind].append(values[at[:, None] + np.arange(columns)])
    read.rows[kind] += len(per_line)


def _read_faces(lines: _Lines, known: IntArray, read: _Collected) -> None:
    """Read the lines `f`: corners as a, a/b, a//c or a/b/c.

    `known` (L, 3) says how many vertices, texture coordinates and normals come before each line: an index below zero
    counts back from them.
    """
    if len(lines.numbers) == 0:
        return
    corner, number = lines.begins(_BLANK, _NEWLINE), lines.begins(_BLANK, _NEWLINE, _SLASH)
    slash = lines.text == _SLASH
    lines.text[slash] = _BLANK
    value = lines.values(lines.per_line(number), np.int64)
    slashes = np.cumsum(slash) - slash  # before each place
    owner = np.cumsum(corner)[number] - 1
    part = slashes[number] - slashes[corner][owner]
    per_line = lines.per_line(corner)
    line = np.repeat(np.arange(len(per_line)), per_line)
    if part.max(initial=0) > 2 or (value == 0).any() or not np.array_equal(owner[part == 0], np.arange(len(line))):
        wrong = (part > 2) | (value == 0)
        at = owner[wrong.argmax()] if wrong.any() else np.setdiff1d(np.arange(len(line)), owner[part == 0])[0]
        raise ValueError(f"line {lines.numbers[line[at]]}: a corner must be v, v/vt, v//vn or v/vt/vn, from 1")
    table = np.full((len(line), 3), -1, dtype=np.int64)
    table[owner, part] = np.where(value > 0, value - 1, known[line[owner], part] + value)
    read.corners.append(table)
    read.counts.append(per_line)
