"""Tells whether an OBJ, PLY or STL file is complete or still being written, without parsing the mesh."""

from __future__ import annotations

import os
import re
import struct
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath

from drivers.errors import IncompleteExportError, UnreadableFileError

_PLY_SIZES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "int32", "uint32", "float", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}
_NUMBER = re.compile(rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_AGAIN = "Wait until the export has finished; if it has, export the scan again"
_HEAD_BYTES = 64 * 1024
_TEXTURE = re.compile(rb"^\s*(?:map_\w+|bump|disp|decal|norm|refl)\s+(.+?)\s*$", re.MULTILINE | re.IGNORECASE)
_MTLLIB = re.compile(rb"^\s*mtllib\s+(.+?)\s*$", re.MULTILINE)
_WHAT = rb"(vertices|vertexes|verts|faces)"
_COUNTS = tuple(
    re.compile(pattern, re.MULTILINE | re.IGNORECASE)
    for pattern in (rb"^#\s*(\d+) " + _WHAT + rb"\s*$", rb"^#\s*" + _WHAT + rb"\s*[:=]?\s*(\d+)\s*$")
)


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
    match path.suffix.lower():
        case ".ply":
            _check_ply(path, size, points=points)
        case ".stl":
            _check_stl(path, size)
        case ".obj":
            _check_obj(path)
        case _:
            pass


def file_has_normals(path: Path) -> bool:
    """Whether a PLY or OBJ file has vertex normals; an OBJ is read up to its first normal or face."""
    if path.suffix.lower() == ".ply":
        header = _ply_header(path)
        return any(element.name == "vertex" and "nx" in element.names for element in header.elements)
    with path.open("rb") as stream:
        # Exporters write vn lines between or after the vertices; a face with a//c refers to one.
        for line in stream:
            if line.startswith(b"vn "):
                return True
            if line.startswith(b"f "):
                return line.split()[1].count(b"/") == 2
    return False


def companions(path: Path) -> tuple[Path, ...]:
    """Find the MTL files of an OBJ and the textures they name, in the same folder and ignoring case.

    Raises:
        IncompleteExportError: a companion is missing, perhaps only for now.
        UnreadableFileError: a companion lies outside the folder.
    """
    if path.suffix.lower() != ".obj":
        return ()
    found: list[Path] = []
    with path.open("rb") as stream:
        names = [match.group(1) for match in _MTLLIB.finditer(stream.read(_HEAD_BYTES))]
    for raw in names:
        library = _beside(path, raw.decode("utf-8", "replace"))
        found.append(library)
        for texture in _TEXTURE.finditer(library.read_bytes()):
            name = _texture_name(texture.group(1).decode("utf-8", "replace"))
            found.append(_beside(path, name, named_in=library))
    return tuple(dict.fromkeys(found))


def companion_names(content: bytes) -> tuple[str, ...]:
    """The files to which the beginning of an OBJ, or an MTL, refers: relative, with `/`, as written there."""
    found = [match.group(1).decode("utf-8", "replace") for match in _MTLLIB.finditer(content[:_HEAD_BYTES])]
    found += [_texture_name(match.group(1).decode("utf-8", "replace")) for match in _TEXTURE.finditer(content)]
    return tuple(PureWindowsPath(name.strip().strip('"')).as_posix() for name in found)


def _texture_name(arguments: str) -> str:
    """The file name in an MTL map statement, after its options (-bm 1.0 -s 1 1 1 …)."""
    words = arguments.split()
    while words and words[0].startswith("-"):
        words.pop(0)
        while len(words) > 1 and re.fullmatch(r"[-+.\deE]+|on|off", words[0]):
            words.pop(0)
    return " ".join(words)


def _beside(path: Path, name: str, named_in: Path | None = None) -> Path:
    """Find the file `name` in the folder of `path` or its subfolders, ignoring case; raises as `companions` does."""
    source = named_in or path
    cleaned = name.strip().strip('"')
    windows, posix = PureWindowsPath(cleaned), PurePosixPath(cleaned)
    if windows.is_absolute() or windows.drive or posix.is_absolute() or ".." in windows.parts or not windows.parts:
        raise UnreadableFileError(
            f"it names the companion {cleaned!r}, which lies outside the export's folder",
            where=str(source),
            remedy="Export into a folder of its own, with the textures beside the mesh",
        )
    here = path.parent
    for part in windows.parts:
        try:
            entries = {entry.casefold(): entry for entry in sorted(os.listdir(here))}
        except NotADirectoryError:
            entries = {}
        match = part if part in entries.values() else entries.get(part.casefold())
        if match is None:
            raise IncompleteExportError(
                f"its companion {cleaned!r} is missing",
                where=str(source),
                remedy="Wait until the export has finished; if it has, export again with materials and textures",
            )
        here = here / match
    if not here.resolve().is_relative_to(path.parent.resolve()):
        raise UnreadableFileError(
            f"its companion {cleaned!r} is a link that leads out of the export's folder",
            where=str(source),
            remedy="Put a copy of the file itself beside the mesh",
        )
    return here


# --- PLY -----------------------------------------------------------------------------------------------


@dataclass
class _Element:
    name: str
    count: int
    fixed_bytes: int = 0
    lists: list[tuple[int, int]] = field(default_factory=list[tuple[int, int]])  # sizes of count and item
    names: list[str] = field(default_factory=list[str])

    @property
    def least_bytes(self) -> int:
        """The minimum size of one row: a face has at least three corners."""
        corners = 3 if self.name == "face" else 0
        first, *rest = self.lists or [(0, 0)]
        return self.fixed_bytes + first[0] + corners * first[1] + sum(size for size, _ in rest)


@dataclass(frozen=True)
class _PlyHeader:
    binary: bool
    elements: list[_Element]
    data_at: int


def _ply_header(path: Path) -> _PlyHeader:
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    if not head.startswith(b"ply"):
        if b"ply".startswith(head[:3]):
            raise IncompleteExportError("the PLY header is cut short", where=str(path), remedy=_AGAIN)
        raise UnreadableFileError(
            "it does not begin like a PLY file", where=str(path), remedy="Export the scan again as PLY"
        )
    end = re.search(rb"end_header\r?\n", head)
    if end is None:
        raise IncompleteExportError("the PLY header is cut short", where=str(path), remedy=_AGAIN)
    elements: list[_Element] = []
    binary = False
    try:
        for line in head[: end.start()].decode("ascii", "replace").splitlines():
            words = line.split()
            if words[:1] == ["format"]:
                binary = words[1] != "ascii"
            elif words[:1] == ["element"]:
                elements.append(_Element(words[1], int(words[2])))
            elif words[:2] == ["property", "list"]:
                elements[-1].lists.append((_PLY_SIZES[words[2]], _PLY_SIZES[words[3]]))
            elif words[:1] == ["property"]:
                elements[-1].fixed_bytes += _PLY_SIZES[words[1]]
                elements[-1].names.append(words[2])
    except (IndexError, KeyError, ValueError) as error:
        raise UnreadableFileError(
            f"the PLY header is wrong ({error})", where=str(path), remedy="Export the scan again as PLY"
        ) from error
    return _PlyHeader(binary, elements, end.end())


def _check_ply(path: Path, size: int, *, points: bool) -> None:
    header = _ply_header(path)
    counts = {element.name: element.count for element in header.elements}
    strips = "tristrips" in counts
    if not counts.get("face") and (strips or not points):
        raise UnreadableFileError(
            "the file holds triangle strips and no faces" if strips else "the file has no faces, only points",
            where=str(path),
            remedy="Export a triangle mesh (faces, not strips or a point cloud)",
        )
    if header.binary:
        # A lower bound, and the exact size for a triangle mesh, which is what scanners write.
        least = header.data_at + sum(element.count * element.least_bytes for element in header.elements)
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


def _last_row_short(path: Path, element: _Element) -> bool:
    """Whether values are missing in the last line of an ASCII PLY that does not end with a newline."""
    words = _tail(path).splitlines()[-1].split()
    if element.lists and words and words[0].isdigit():
        return len(words) < 1 + int(words[0]) + len(element.names)
    return len(words) < len(element.names)


def _count_lines(path: Path, start: int) -> tuple[int, bool]:
    """The number of lines after byte `start`, and whether the last one ends with a newline."""
    lines, last = 0, b"\n"
    with path.open("rb") as stream:
        stream.seek(start)
        while chunk := stream.read(1 << 22):
            lines += chunk.count(b"\n")
            last = chunk[-1:]
    ended = last == b"\n"
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
    count = struct.unpack("<I", head[80:84])[0] if len(head) >= 84 else None
    expected = None if count is None else 84 + 50 * count
    text = head.lstrip()[:5].lower() == b"solid" and b"\0" not in head
    if expected == size or not text:
        if expected is None or size < expected:
            raise IncompleteExportError(
                f"the file is cut short: {size} bytes of {expected or 'at least 84'} that its header announces",
                where=str(path),
                remedy=_AGAIN,
            )
        if size > expected:
            raise UnreadableFileError(
                f"its size ({size} bytes) does not agree with the {count} triangles that its header announces",
                where=str(path),
                remedy="Export the scan again as binary STL",
            )
        if count == 0:
            raise UnreadableFileError("the file has no faces", where=str(path), remedy="Export a mesh with triangles")
        return
    if b"endsolid" not in _tail(path).lower():
        raise IncompleteExportError(
            "the file is cut short: an ASCII STL ends with 'endsolid'", where=str(path), remedy=_AGAIN
        )


# --- OBJ -----------------------------------------------------------------------------------------------


def _check_obj(path: Path) -> None:
    """Check an OBJ, which states no length and has no end mark, by its last line and by counts in its comments."""
    tail = _tail(path)
    last = tail.splitlines()[-1].strip() if tail.strip() else b""
    # Some exporters write no final newline. The last line must then be as complete as the previous one of its kind.
    # A number that lost its last digits is not detected, so a watched folder also waits until the file is stable.
    if not tail.endswith(b"\n") and _cut_line(tail, last):
        raise IncompleteExportError(
            f"the file ends in the middle of a line ({last[:40].decode('utf-8', 'replace')!r})",
            where=str(path),
            remedy=_AGAIN,
        )
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    announced: dict[bytes, int] = {}
    for pattern in _COUNTS:
        for pair in pattern.findall(head + b"\n" + tail):
            number, what = sorted(pair)  # digits sort before letters
            # Each of several objects may state its own count: the largest is a lower bound of the total.
            announced[what[:1].lower()] = max(int(number), announced.get(what[:1].lower(), 0))
    vertices = faces = 0
    with path.open("rb") as stream:
        while block := stream.readlines(1 << 22):
            joined = b"".join([b"\n", *block])
            vertices += joined.count(b"\nv ") + joined.count(b"\nv\t")
            faces += joined.count(b"\nf ") + joined.count(b"\nf\t")
    for name, have in ((b"v", vertices), (b"f", faces)):
        want = announced.get(name)
        if want is not None and have < want:
            what = "vertices" if name == b"v" else "faces"
            raise IncompleteExportError(
                f"the file is cut short: {have} {what} of {want} that it announces", where=str(path), remedy=_AGAIN
            )
    if faces == 0:
        if last.startswith((b"v ", b"vn ", b"vt ")) and vertices:
            # A point cloud looks like an export that has not reached its faces yet.
            raise UnreadableFileError(
                "the file has no faces, only points",
                where=str(path),
                remedy="Wait if the export is still running; otherwise export a triangle mesh, not a point cloud",
            )
        raise UnreadableFileError("the file has no faces", where=str(path), remedy="Export a triangle mesh")


def _cut_line(tail: bytes, last: bytes) -> bool:
    """Whether the last line, which has no newline, is less complete than the previous line of its kind."""
    if last.startswith(b"#"):
        return False
    words = last.split()
    keyword, values = words[0], words[1:]
    if keyword not in {b"v", b"vn", b"vt", b"f", b"g", b"o", b"s", b"usemtl"} or not values:
        return True
    if keyword in {b"g", b"o", b"s", b"usemtl"}:
        return False
    before = [line.split()[1:] for line in tail.splitlines()[1:-1] if line.split()[:1] == [keyword]]
    if keyword != b"f":
        return not before or len(values) < len(before[-1]) or not _NUMBER.fullmatch(values[-1])
    slashes = {value.count(b"/") for value in (before[-1] if before else values)}
    return (
        len(values) < 3
        or not all(_NUMBER.fullmatch(part) for value in values for part in value.split(b"/") if part)
        or values[-1].endswith((b"/", b"-"))
        or {value.count(b"/") for value in values} != slashes
    )
