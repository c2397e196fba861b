"""Tells whether an OBJ, PLY or STL file is complete or still being written, without parsing the mesh."""

from __future__ import annotations

import re
import struct
from pathlib import Path

from drivers.errors import IncompleteExportError, UnreadableFileError
from drivers.foreign_code import reading
from drivers.meshes.foreign_text import logical_lines, readings
from drivers.meshes.ply import TEXTURE_FACE, Element, read_header
from drivers.meshes.stl import announced_bytes

_NUMBER = re.compile(rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_AGAIN = "Wait until the export has finished; if it has, export the scan again"
_HEAD_BYTES = 64 * 1024
_WHAT = rb"(vertices|vertexes|verts|faces)"
_COUNTS = tuple(
    re.compile(pattern, re.MULTILINE | re.IGNORECASE)
    for pattern in (rb"^#\s*(\d{1,18}) " + _WHAT + rb"\s*$", rb"^#\s*" + _WHAT + rb"\s*[:=]?\s*(\d{1,18})\s*$")
)
_SUFFIXES = (".obj", ".ply", ".stl", ".off", ".glb")
_MARK = rb"(?:\xef\xbb\xbf)?\s*"
# What a file begins with, what it is then, and the names that it may have.
_CONTENTS = (
    (re.compile(_MARK + rb"ply[ \t]*[\r\n]"), "a PLY", (".ply",)),
    (re.compile(_MARK + rb"solid\b.*\bfacet\b", re.IGNORECASE | re.DOTALL), "an STL", (".stl",)),
    (re.compile(_MARK + rb"(?:ST)?C?N?OFF\s"), "an OFF", (".off",)),
    (re.compile(rb"glTF"), "a GLB", (".glb",)),
    (
        re.compile(_MARK + rb"(?:#[^\n]*\n\s*)*(?:mtllib [^\n]*\s+)?(?:[og] [^\n]*\s+)?v[ \t]+[-\d.]"),
        "an OBJ",
        (".obj",),
    ),
    (re.compile(rb"PK\x03\x04"), "a ZIP archive", ()),
    (re.compile(rb"\x1f\x8b"), "a file compressed by gzip", ()),
    (re.compile(rb"version https://git-lfs"), "a pointer to a file that Git LFS has not fetched", ()),
)
_LEAST = {b"v": 3, b"vn": 3, b"vt": 1, b"f": 3}  # words after the keyword
_NAMED = (b"usemtl", b"mtllib")


def check_complete(path: Path, *, points: bool = False) -> None:
    """Check that a mesh file is complete and has faces; with `points`, a PLY file may have none.

    Raises:
        IncompleteExportError: the file is truncated.
        UnreadableFileError: the file has no faces, or is damaged.
        OSError: the file is missing or locked.
    """
    size = path.stat().st_size
    if size == 0:
        raise IncompleteExportError("the file is empty", where=str(path), remedy=_AGAIN)
    with reading(path, "a mesh", "Export the scan again"):
        _check_content(path)
        match path.suffix.lower():
            case ".ply":
                _check_ply(path, size, points=points)
            case ".stl":
                _check_stl(path, size)
            case ".obj":
                _check_obj(path)
            case _:
                pass


def _check_content(path: Path) -> None:
    """Refuse a file whose content is plainly of another kind than its name says."""
    with path.open("rb") as stream:
        head = stream.read(1024)
    suffix = path.suffix.lower()
    for pattern, what, right in _CONTENTS:
        if suffix in _SUFFIXES and suffix not in right and pattern.match(head):
            raise UnreadableFileError(
                f"its content is that of {what}, and its name ends with {path.suffix}",
                where=str(path),
                remedy=f"Give it a name that ends with {right[0]}"
                if right
                else "Unpack it, or export the scan again",
            )


# --- PLY -----------------------------------------------------------------------------------------------


def _check_ply(path: Path, size: int, *, points: bool) -> None:
    header = read_header(path)
    strips = any(element.name == "tristrips" for element in header.elements)
    if not header.count("face") and (strips or not points):
        raise UnreadableFileError(
            "the file holds triangle strips and no faces" if strips else "the file has no faces, only points",
            where=str(path),
            remedy="Export a triangle mesh (faces, not strips or a point cloud)",
        )
    if header.order:
        # A lower bound, and the exact size for a triangle mesh, which is what scanners write.
        least = header.data_at + sum(element.count * _least_bytes(element) for element in header.elements)
        if size < least:
            raise IncompleteExportError(
                f"the file is cut short: {size} bytes of at least {least} that its header announces",
                where=str(path),
                remedy=_AGAIN,
            )
        return
    rows = sum(element.count for element in header.elements)
    lines, ended = _count_lines(path, header.data_at)
    if lines < rows or (lines == rows and not ended and _last_row_short(path, header.elements[-1])):
        raise IncompleteExportError(
            f"the file is cut short: {lines} lines of {rows} that its header announces",
            where=str(path),
            remedy=_AGAIN,
        )


def _least_bytes(element: Element) -> int:
    """The least size of a row: a face has at least three corners, and so have its texture's corners."""
    corners = [one.kind for one in element.properties if one.count_kind and "ind" in one.name]
    if element.name not in ("face", TEXTURE_FACE):
        corners = []
    return element.least_bytes + 3 * sum(struct.calcsize(kind) for kind in corners)


def _last_row_short(path: Path, element: Element) -> bool:
    """Return whether values are missing in the last line of an ASCII PLY that does not end with a newline."""
    words = _tail(path).splitlines()[-1].split()
    at = 0
    for one in element.properties:
        if one.count_kind:
            if not words[at : at + 1] or not words[at].isdigit():
                return True
            at += int(words[at])
        at += 1
    return len(words) < at


def _count_lines(path: Path, start: int) -> tuple[int, bool]:
    """The number of lines after byte `start`, and whether the last one ends with a newline."""
    lines, last = 0, b"\n"
    with path.open("rb") as stream:
        stream.seek(start - 1)
        newline = b"\r" if stream.read(1) == b"\r" else b"\n"  # as the header's
        while chunk := stream.read(1 << 22):
            lines += chunk.count(newline)
            last = chunk[-1:]
    ended = last in {newline, b"\n"}
    return lines + (not ended), ended


def _tail(path: Path, size: int = 4096) -> bytes:
    with path.open("rb") as stream:
        stream.seek(max(0, path.stat().st_size - size))
        return stream.read()


# --- STL -----------------------------------------------------------------------------------------------


def _check_stl(path: Path, size: int) -> None:
    with path.open("rb") as stream:
        head = stream.read(1024)
    # Some binary files begin with "solid" too, so the size decides first.
    expected = announced_bytes(head)
    if head[:2] in {b"\xff\xfe", b"\xfe\xff"} and expected != size:
        raise UnreadableFileError(
            "it is STL as UTF-16 text",
            where=str(path),
            remedy="Export the scan again, and do not save it with a text editor",
        )
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()[:5].lower() == b"solid" and b"\0" not in head
    if expected == size or not text:
        if expected is None or size < expected:
            raise IncompleteExportError(
                f"the file is cut short: {size} bytes of {expected or 'at least 84'} that its header announces",
                where=str(path),
                remedy=_AGAIN,
            )
        if size > expected:
            raise UnreadableFileError(
                f"its size ({size} bytes) does not agree with the {(expected - 84) // 50} triangles of its header",
                where=str(path),
                remedy="Export the scan again as binary STL",
            )
        if expected == 84:
            raise UnreadableFileError("the file has no faces", where=str(path), remedy="Export a mesh with triangles")
        return
    if b"endsolid" not in _tail(path).lower():
        raise IncompleteExportError(
            "the file is cut short: an ASCII STL ends with 'endsolid'", where=str(path), remedy=_AGAIN
        )


# --- OBJ -----------------------------------------------------------------------------------------------


def _check_obj(path: Path) -> None:
    """Check an OBJ, which states no length and has no end mark, by its last line and by counts in its comments."""
    head, tail = b"", b""
    vertices = faces = 0
    for block in logical_lines(path):
        head = head or block[:_HEAD_BYTES]
        tail = block[-_HEAD_BYTES:] if len(block) > 4096 else (tail + block)[-_HEAD_BYTES:]
        vertices += block.count(b"\nv ") + block.startswith(b"v ")
        faces += block.count(b"\nf ") + block.startswith(b"f ")
    cut = len(tail) == _HEAD_BYTES
    lines = [line for line in tail.split(b"\n")[cut:] if line.strip()]
    # Some exporters write no final newline. The last line must then be as complete as the previous one of its kind.
    # A number that lost its last digits is not detected, so a watched folder also waits until the file is stable.
    if lines and not _ends_line(path) and _cut_line(lines):
        raise IncompleteExportError(
            f"the file ends in the middle of a line ({readings(lines[-1][:40])[0]!r})",
            where=str(path),
            remedy=_AGAIN,
        )
    announced: dict[bytes, int] = {}
    for pattern in _COUNTS:
        for pair in pattern.findall(head + b"\n" + tail):
            number, what = sorted(pair)  # digits sort before letters
            # Each of several objects may state its own count: the largest is a lower bound of the total.
            announced[what[:1].lower()] = max(int(number), announced.get(what[:1].lower(), 0))
    for name, have in ((b"v", vertices), (b"f", faces)):
        want = announced.get(name)
        if want is not None and have < want:
            what = "vertices" if name == b"v" else "faces"
            raise IncompleteExportError(
                f"the file is cut short: {have} {what} of {want} that it announces", where=str(path), remedy=_AGAIN
            )
    if faces == 0:
        if vertices and lines[-1].startswith((b"v ", b"vn ", b"vt ")):
            # A point cloud looks like an export that has not reached its faces yet.
            raise UnreadableFileError(
                "the file has no faces, only points",
                where=str(path),
                remedy="Wait if the export is still running; otherwise export a triangle mesh, not a point cloud",
            )
        raise UnreadableFileError("the file has no faces", where=str(path), remedy="Export a triangle mesh")


def _ends_line(path: Path) -> bool:
    return _tail(path, 4).rstrip(b"\0")[-1:] in {b"\n", b"\r"}


def _cut_line(lines: list[bytes]) -> bool:
    """Say whether the last line, which has no newline, is less complete than the previous one of its kind."""
    keyword, *values = lines[-1].split()
    if lines[-1].endswith(b"\\") and keyword in _LEAST:
        return True
    if keyword not in _LEAST:
        # Half a keyword, or one without its name; what is not known has no length to judge by.
        return not values and any(name.startswith(keyword) for name in _NAMED)
    before = next((line.split()[1:] for line in reversed(lines[:-1]) if line.split()[0] == keyword), None)
    if keyword != b"f":
        least = _LEAST[keyword] if before is None else len(before)
        return len(values) < least or not _NUMBER.fullmatch(values[-1])
    slashes = {value.count(b"/") for value in (before or values)}
    return (
        len(values) < 3
        or not all(_NUMBER.fullmatch(part) for value in values for part in value.split(b"/") if part)
        or values[-1].endswith((b"/", b"-"))
        or {value.count(b"/") for value in values} != slashes
    )
