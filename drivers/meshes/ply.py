"""Reads PLY files, ASCII and binary of both byte orders, with faces of any number of corners and further elements.

Trimesh takes all faces of a binary file to have as many corners as the first.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.errors import IncompleteExportError, UnreadableFileError
from drivers.interfaces import Array
from drivers.meshes.companions import numbered_textures
from drivers.meshes.foreign_text import numbers, readings
from drivers.meshes.raw_mesh import IntArray, Polygons, RawMesh, raw_mesh

_AGAIN = "Wait until the export has finished; if it has, export the scan again"
_HEAD_BYTES = 1 << 20
_BLOCK_BYTES = 1 << 24
_KINDS = {
    **dict.fromkeys(("char", "int8"), "b"),
    **dict.fromkeys(("uchar", "uint8"), "B"),
    **dict.fromkeys(("short", "int16"), "h"),
    **dict.fromkeys(("ushort", "uint16"), "H"),
    **dict.fromkeys(("int", "int32"), "i"),
    **dict.fromkeys(("uint", "uint32"), "I"),
    **dict.fromkeys(("int64", "long"), "q"),
    **dict.fromkeys(("uint64", "ulong"), "Q"),
    **dict.fromkeys(("float", "float32"), "f"),
    **dict.fromkeys(("double", "float64"), "d"),
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_TEXTURES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
# Artec Studio writes the places on textures, and which image each is of, as elements of their own.
TEXTURE_VERTEX, TEXTURE_FACE = "multi_texture_vertex", "multi_texture_face"


@dataclass(frozen=True, slots=True)
class Property:
    """A property of an element: the letter of its type, as in `struct`, and that of its count if it is a list."""

    name: str
    kind: str
    count_kind: str = ""


@dataclass(frozen=True, slots=True)
class Element:
    """A kind of row: its name, how many there are, and what each has."""

    name: str
    count: int
    properties: list[Property] = field(default_factory=list[Property])

    @property
    def least_bytes(self) -> int:
        """The least size of a row in a binary file."""
        return sum(struct.calcsize(one.count_kind or one.kind) for one in self.properties)


@dataclass(frozen=True, slots=True)
class PlyHeader:
    """The header: the byte order as in `struct`, empty for text; the elements; where the data begin."""

    order: str
    elements: list[Element]
    data_at: int

    def count(self, name: str) -> int:
        """The number of rows of an element."""
        return sum(element.count for element in self.elements if element.name == name)


@dataclass(frozen=True, slots=True)
class Rows:
    """The rows of an element: its columns (N,), and its lists as all their values (L,) and how many each row has."""

    columns: dict[str, Array] = field(repr=False)
    lists: dict[str, tuple[Array, IntArray]] = field(repr=False)

    def table(self, *names: str) -> Array | None:
        """Columns side by side, (N, K); None if one is missing."""
        if not self.columns.keys() >= set(names):
            return None
        return np.stack([self.columns[name].astype(np.float64) for name in names], axis=1)


def read_header(path: Path) -> PlyHeader:
    """Read the header of a PLY.

    Raises:
        IncompleteExportError: it is cut short.
        UnreadableFileError: it is wrong.
    """
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    mark = len(head) - len(head.removeprefix(b"\xef\xbb\xbf"))
    begin = re.match(rb"ply[ \t]*(\r\n|\n|\r)", head[mark:])
    if begin is None:
        if b"ply".startswith(head[mark:].strip()):
            raise IncompleteExportError("the PLY header is cut short", where=str(path), remedy=_AGAIN)
        wide = head[:1] + head[2:3] in {b"pl", b"\xfep", b"\xffp"} or head[1:4:2] == b"pl"
        raise UnreadableFileError(
            "it is PLY as UTF-16 text" if wide else "it does not begin like a PLY file",
            where=str(path),
            remedy="Export the scan again as PLY, and do not save it with a text editor",
        )
    newline = begin[1]  # the header ends with the same, and data that follow may begin with any byte
    end = re.search(rb"(?:^|[\r\n])end_header[ \t]*" + newline, head)
    if end is None:
        raise IncompleteExportError("the PLY header is cut short", where=str(path), remedy=_AGAIN)
    order, elements = "", list[Element]()
    try:
        for line in head[mark : end.start()].split(newline):
            words = line.split()
            if words[:1] == [b"format"]:
                order = _ORDERS[words[1].decode("ascii", "replace")]
            elif words[:1] == [b"element"]:
                elements.append(Element(readings(words[1])[0], _count(words[2])))
            elif words[:2] == [b"property", b"list"]:
                elements[-1].properties.append(_property(words[4], words[3], words[2]))
            elif words[:1] == [b"property"]:
                elements[-1].properties.append(_property(words[2], words[1]))
    except (IndexError, KeyError, ValueError) as error:
        raise UnreadableFileError(
            f"the PLY header is wrong ({error})", where=str(path), remedy="Export the scan again as PLY"
        ) from error
    return PlyHeader(order, elements, end.end())


def _count(word: bytes) -> int:
    count = int(word)
    if count < 0:
        raise ValueError(f"{count} rows")
    return count


def _property(name: bytes, kind: bytes, count_kind: bytes = b"") -> Property:
    known = [_KINDS[word.decode("ascii", "replace")] for word in (kind, count_kind) if word]
    return Property(readings(name)[0].lower(), *known)


def read_rows(path: Path) -> dict[str, Rows]:
    """Read all elements of a PLY, by name.

    Raises:
        IncompleteExportError: the file is cut short.
        ValueError: it does not hold what its header announces.
        UnreadableFileError: read_header raises it.
        OSError: it cannot be read.
    """
    try:
        return _all_rows(path, read_header(path))
    except _CutShortError as error:
        raise IncompleteExportError(f"the file is cut short: {error}", where=str(path), remedy=_AGAIN) from error


def _all_rows(path: Path, header: PlyHeader) -> dict[str, Rows]:
    cells = _Cells.of(path, header)
    at, found = 0, dict[str, Rows]()
    for element in header.elements:
        least = sum(cells.width(one.count_kind or one.kind) for one in element.properties)
        if least * element.count > len(cells.data) - at:
            raise _CutShortError
        found[element.name], at = _rows(cells, element, at)
    if cells.data[at:].tobytes().strip(b"\r\n \0"):
        raise ValueError("it is longer than its header announces")
    return found


def read_ply(path: Path) -> RawMesh:
    """Read the polygons of a PLY. Raises as read_rows does, and IncompleteExportError if a texture is missing."""
    found = read_rows(path)
    if "vertex" not in found or (vertices := found["vertex"].table("x", "y", "z")) is None:
        raise ValueError("it has no vertices with x, y and z")
    vertex, face = found["vertex"], found.get("face", Rows({}, {}))
    corners, counts = _indices(face)
    uv = next((table for names in _TEXTURES if (table := vertex.table(*names)) is not None), None)
    corner_uv = None if uv is None or not _within(corners, len(uv)) else uv[corners]
    numbered_textures(path, _texture_count(found))
    corner_uv = _wedges(found, corners, counts) if TEXTURE_FACE in found else corner_uv
    wedges, each = face.lists.get("texcoord", (None, None))
    if wedges is not None and np.array_equal(np.asarray(each), 2 * counts):
        corner_uv = wedges.astype(np.float64).reshape(-1, 2)
    return raw_mesh(
        vertices,
        Polygons(corners, counts, corner_uv=corner_uv),
        normals=vertex.table("nx", "ny", "nz"),
        colours=_colours(vertex),
    )


def _texture_count(rows: Mapping[str, Rows]) -> int:
    """The number of texture images to which a PLY of Artec Studio refers; 0 for others."""
    texture = rows.get(TEXTURE_VERTEX, Rows({}, {})).columns.get("tx", np.empty(0))
    return int(texture.max()) + 1 if len(texture) else 0


def _wedges(found: Mapping[str, Rows], corners: IntArray, counts: IntArray) -> Array | None:
    """The places (C, 2) of the faces' corners on textures, as Artec Studio writes them; None if not all have."""
    vertex = found.get(TEXTURE_VERTEX, Rows({}, {}))
    places = next((table for names in _TEXTURES if (table := vertex.table(*names)) is not None), None)
    index, each = _indices(found[TEXTURE_FACE])
    if places is None or not np.array_equal(each, counts) or not _within(index, len(places)):
        return None
    return places[index]


def _within(index: IntArray, count: int) -> bool:
    return len(index) > 0 and index.min() >= 0 and index.max() < count


def _indices(face: Rows) -> tuple[IntArray, IntArray]:
    """The corners of the faces, and how many each has."""
    names = [name for name in ("vertex_indices", "vertex_index") if name in face.lists]
    names = names or [name for name in face.lists if "ind" in name]
    if not names and face.lists:
        raise ValueError(f"its faces have no list of vertices, only {', '.join(face.lists)}")
    values, counts = face.lists[names[0]] if names else (np.empty(0), np.empty(0, np.int64))
    return values.astype(np.int64), counts


def _colours(vertex: Rows) -> Array | None:
    for names in _COLOURS:
        if (table := vertex.table(*names)) is not None:
            whole = {"u1": 255.0, "u2": 65535.0}.get(vertex.columns[names[0]].dtype.str[1:])
            # Text has no types: values above 1 are bytes.
            return table / (whole or (255.0 if table.max(initial=0) > 1 else 1.0))
    return None


# --- rows ----------------------------------------------------------------------------------------------


class _CutShortError(ValueError):
    """The data end before the last row."""

    def __init__(self) -> None:
        super().__init__("it is shorter than its header announces")


@dataclass(frozen=True, slots=True)
class _Cells:
    """The data after the header: bytes, or in a text its numbers; `order` is the byte order, empty for text."""

    data: NDArray[Any]
    order: str

    @classmethod
    def of(cls, path: Path, header: PlyHeader) -> _Cells:
        with path.open("rb") as stream:
            stream.seek(header.data_at)
            if header.order:
                return cls(np.fromfile(stream, dtype=np.uint8), header.order)
            parts, rest = [np.empty(0)], b""
            while chunk := stream.read(_BLOCK_BYTES):
                chunk = rest + chunk
                end = max(chunk.rfind(blank) for blank in (b"\n", b" ", b"\r", b"\t")) + 1
                parts.append(numbers(chunk[:end]))
                rest = chunk[end:]
            parts.append(numbers(rest))
        return cls(np.concatenate(parts), "")

    def width(self, kind: str) -> int:
        """How many cells a value takes."""
        return struct.calcsize(kind) if self.order else 1

    def one(self, at: int, kind: str) -> int:
        """The count of a list."""
        count = struct.unpack_from(self.order + kind, self.data.data, at)[0] if self.order else self.data[at]
        if not (0 <= count <= len(self.data) and count == int(count)):
            raise ValueError(f"a list of {count} values")
        return int(count)

    def regular(self, at: int, rows: int, stride: int, items: int, kind: str) -> Array:
        """Values that lie in the same place of each row, (rows, items)."""
        unit = self.data.itemsize
        dtype = np.dtype(self.order + kind) if self.order else self.data.dtype
        strides = (stride * unit, self.width(kind) * unit)
        return np.ndarray((rows, items), dtype, self.data.data, at * unit, strides).astype(dtype.newbyteorder("="))

    def scattered(self, at: IntArray, items: int, kind: str) -> Array:
        """Values that begin at these places, (len(at), items)."""
        if not self.order:
            return self.data[at[:, None] + np.arange(items)]
        dtype = np.dtype(self.order + kind)
        places = at[:, None] + np.arange(items * dtype.itemsize)
        return self.data[places].view(dtype).astype(dtype.newbyteorder("=")).reshape(len(at), items)


def _rows(cells: _Cells, element: Element, at: int) -> tuple[Rows, int]:
    """Read the rows of an element that begin at a place; returns them and where they end. Raises ValueError."""
    if element.count == 0:
        empty = np.empty(0)
        lists = {one.name: (empty, np.empty(0, np.int64)) for one in element.properties if one.count_kind}
        return Rows({one.name: empty for one in element.properties if not one.count_kind}, lists), at
    counts = _row_counts(cells, element, at)
    stride = sum(
        cells.width(one.count_kind) + count * cells.width(one.kind) if one.count_kind else cells.width(one.kind)
        for one, count in zip(element.properties, counts, strict=True)
    )
    end = at + element.count * stride
    if end <= len(cells.data):
        found = _alike(cells, element, at, counts, stride)
        if found is not None:
            return found, end
    return _each(cells, element, at)


def _row_counts(cells: _Cells, element: Element, at: int) -> list[int]:
    """How many values each list of the row at a place has; 0 for what is no list."""
    counts: list[int] = []
    for one in element.properties:
        count = 0
        if one.count_kind:
            if at + cells.width(one.count_kind) > len(cells.data):
                raise _CutShortError
            count = cells.one(at, one.count_kind)
            at += cells.width(one.count_kind) + count * cells.width(one.kind)
        else:
            at += cells.width(one.kind)
        counts.append(count)
    return counts


def _alike(cells: _Cells, element: Element, at: int, counts: list[int], stride: int) -> Rows | None:
    """The rows, if the lists of all have as many values as those of the first."""
    rows = Rows({}, {})
    n = element.count
    for one, count in zip(element.properties, counts, strict=True):
        if not one.count_kind:
            rows.columns[one.name] = cells.regular(at, n, stride, 1, one.kind)[:, 0]
            at += cells.width(one.kind)
            continue
        if not (cells.regular(at, n, stride, 1, one.count_kind) == count).all():
            return None
        at += cells.width(one.count_kind)
        values = cells.regular(at, n, stride, count, one.kind).reshape(-1)
        rows.lists[one.name] = values, np.full(n, count, dtype=np.int64)
        at += count * cells.width(one.kind)
    return rows


def _each(cells: _Cells, element: Element, at: int) -> tuple[Rows, int]:
    """The rows one by one, as their lists differ in length; where they end."""
    steps: list[tuple[int, str, int, int]] = []  # before each list: cells of other values; its types in cells
    gap = 0
    for one in element.properties:
        if one.count_kind:
            steps.append((gap, one.count_kind, cells.width(one.count_kind), cells.width(one.kind)))
            gap = 0
        else:
            gap += cells.width(one.kind)
    begins: list[list[int]] = [[] for _ in range(len(steps) + 1)]
    counts: list[list[int]] = [[] for _ in steps]
    try:
        for _ in range(element.count):
            for k, (before, kind, count_width, width) in enumerate(steps):
                begins[k].append(at)
                at += before
                count = cells.one(at, kind)
                counts[k].append(count)
                at += count_width + count * width
            begins[-1].append(at)
            at += gap
    except (struct.error, IndexError):
        raise _CutShortError from None
    if at > len(cells.data):
        raise _CutShortError
    rows = Rows({}, {})
    k, offset = 0, 0
    for one in element.properties:
        begin = np.array(begins[k], dtype=np.int64) + offset
        if not one.count_kind:
            rows.columns[one.name] = cells.scattered(begin, 1, one.kind)[:, 0]
            offset += cells.width(one.kind)
            continue
        lengths = np.array(counts[k], dtype=np.int64)
        values = _ragged(cells, begin + cells.width(one.count_kind), lengths, one.kind)
        rows.lists[one.name] = values, lengths
        k, offset = k + 1, 0
    return rows, at


def _ragged(cells: _Cells, begin: IntArray, lengths: IntArray, kind: str) -> Array:
    """The values of lists that begin at these places, one after another."""
    first = np.cumsum(lengths) - lengths
    found: Array = np.empty(int(lengths.sum()), dtype=np.dtype(kind) if cells.order else np.float64)
    for length in np.unique(lengths[lengths > 0]).tolist():
        rows = np.flatnonzero(lengths == length)
        found[first[rows, None] + np.arange(length)] = cells.scattered(begin[rows], length, kind)
    return found
