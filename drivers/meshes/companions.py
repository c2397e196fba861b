"""The files that belong to a mesh: the materials of an OBJ, and the textures that these or a PLY name."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath, PureWindowsPath

from drivers.errors import IncompleteExportError, UnreadableFileError
from drivers.meshes.foreign_text import alike, logical_lines, readings

_HEAD_BYTES = 64 * 1024
_TEXTURE = re.compile(rb"^\s*(?:map_\w+|bump|disp|decal|norm|refl)\s+(.+?)\s*$", re.MULTILINE | re.IGNORECASE)
_MTLLIB = re.compile(rb"^\s*mtllib\s+(.+?)\s*$", re.MULTILINE)
# What Artec Studio writes in a PLY with textures: it does not name them, they are NAME_0.jpg, NAME_1.jpg, …
_NUMBERED = re.compile(rb"^element\s+multi_texture_vertex\s+0*[1-9]", re.MULTILINE)
TEXTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".tga")
_TEXTURE_FILE = re.compile(rb"^comment\s+TextureFile\s+(.+?)\s*$", re.MULTILINE | re.IGNORECASE)


def companions(path: Path) -> tuple[Path, ...]:
    """Find the MTL files of an OBJ and the textures they name, or those of a PLY, in the same folder.

    A PLY of Artec Studio has textures without naming them. A name is compared in every encoding that it may be in,
    ignoring case and how accents are composed.

    Raises:
        IncompleteExportError: a companion is missing, perhaps only for now.
        UnreadableFileError: a companion lies outside the folder.
    """
    suffix = path.suffix.lower()
    if suffix not in {".obj", ".ply"}:
        return ()
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    found: list[Path] = []
    if suffix == ".ply":
        header = head.split(b"end_header", maxsplit=1)[0].replace(b"\r", b"\n")
        found = [_beside(path, name[1]) for name in _TEXTURE_FILE.finditer(header)]
        if _NUMBERED.search(header):
            found += numbered_textures(path, 1)
        return tuple(dict.fromkeys(found))
    for library in _libraries(path, next(logical_lines(path), b"")[:_HEAD_BYTES]):
        found.append(library)
        for texture in _TEXTURE.finditer(b"".join(logical_lines(library))):
            found.append(_beside(path, _texture_name(texture[1]), named_in=library))
    return tuple(dict.fromkeys(found))


def numbered_textures(path: Path, at_least: int) -> list[Path]:
    """The textures of a PLY that counts them: NAME_0, NAME_1, … beside it, of any kind of image.

    Raises IncompleteExportError if there are fewer than `at_least`, perhaps only for now.
    """
    found: list[Path] = []
    while here := _numbered(path, len(found)):
        found.append(here)
    if len(found) < at_least:
        raise IncompleteExportError(
            f"its texture {path.stem}_{len(found)} (.jpg or another image) is missing",
            where=str(path),
            remedy="Wait until the export has finished; if it has, export again, with its textures beside the mesh",
        )
    return found


def _numbered(path: Path, number: int) -> Path | None:
    names = (f"{path.stem}_{number}{suffix}" for suffix in TEXTURE_SUFFIXES)
    return next((here for name in names if (here := _find(path.parent, name, os.fsencode(name))) is not None), None)


def companion_names(content: bytes) -> Iterator[str]:
    """The files to which the beginning of an OBJ or PLY, or an MTL, refers: relative, with `/`, as written there.

    A name whose encoding is not known comes once for each that it may be in.
    """
    head = content[:_HEAD_BYTES]
    raws = [match[1] for pattern in (_MTLLIB, _TEXTURE_FILE) for match in pattern.finditer(head)]
    raws += [_texture_name(match[1]) for match in _TEXTURE.finditer(content)]
    for raw in raws:
        for name in readings(raw):
            yield PureWindowsPath(name.strip().strip('"')).as_posix()


def _libraries(path: Path, head: bytes) -> Iterator[Path]:
    for match in _MTLLIB.finditer(head):
        try:
            yield _beside(path, match[1])
        except IncompleteExportError:
            # One statement may name several, and a name may have blanks.
            several = re.findall(rb"\S+?\.mtl(?=\s|$)", match[1], re.IGNORECASE)
            if len(several) < 2 or b" ".join(several) != b" ".join(match[1].split()):
                raise
            yield from (_beside(path, one) for one in several)


def _texture_name(arguments: bytes) -> bytes:
    """The file name in an MTL map statement, after its options (-bm 1.0 -s 1 1 1 …)."""
    words = arguments.split()
    while words and words[0].startswith(b"-"):
        words.pop(0)
        while len(words) > 1 and re.fullmatch(rb"[-+.\deE]+|on|off", words[0]):
            words.pop(0)
    return b" ".join(words)


def _beside(path: Path, raw: bytes, named_in: Path | None = None) -> Path:
    """Find a file in the folder of `path` or its subfolders by its name there; raises as `companions` does."""
    source = named_in or path
    names = [name.strip().strip('"') for name in readings(raw)]
    inside = [name for name in names if not _leads_out(name)]
    if not inside:
        raise UnreadableFileError(
            f"it names the companion {names[0]!r}, which lies outside the export's folder",
            where=str(source),
            remedy="Export into a folder of its own, with the textures beside the mesh",
        )
    here = next((found for name in inside if (found := _find(path.parent, name, raw)) is not None), None)
    if here is None:
        raise IncompleteExportError(
            f"its companion {inside[0]!r} is missing",
            where=str(source),
            remedy="Wait until the export has finished; if it has, export again with materials and textures",
        )
    if not here.resolve().is_relative_to(path.parent.resolve()):
        raise UnreadableFileError(
            f"its companion {inside[0]!r} is a link that leads out of the export's folder",
            where=str(source),
            remedy="Put a copy of the file itself beside the mesh",
        )
    return here


def _leads_out(name: str) -> bool:
    windows, posix = PureWindowsPath(name), PurePosixPath(name)
    odd = windows.is_absolute() or windows.drive or posix.is_absolute() or ".." in windows.parts
    return bool(odd) or not windows.parts


def _find(folder: Path, name: str, raw: bytes) -> Path | None:
    here = folder
    for part in PureWindowsPath(name).parts:
        try:
            entries = sorted(os.listdir(here))
        except NotADirectoryError:
            return None
        match = next((entry for entry in entries if os.fsencode(entry) == raw or entry == part), None)
        if match is None:
            same = (entry for entry in entries if alike(part) in map(alike, readings(os.fsencode(entry))))
            match = next(same, None)
        if match is None:
            return None
        here = here / match
    return here
