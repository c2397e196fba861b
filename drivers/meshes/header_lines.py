"""The header of a file with a surface, as lines for a recording of devices: no names, comments or coordinates."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from drivers.interfaces import FileHeader
from drivers.meshes.stl import announced_bytes

_HEAD_BYTES = 1 << 16
_MAGIC_BYTES = 8
_WORDS = ("v", "vt", "vn", "vp", "f", "l", "o", "g", "s", "mtllib", "usemtl", "OFF", "solid", "facet", "vertex")


def header_lines(path: Path) -> FileHeader | str:
    """The header of a file; or a sentence with the reason if it cannot be read."""
    try:
        size = path.stat().st_size
        with path.open("rb") as stream:
            head = stream.read(_HEAD_BYTES)
    except OSError as error:
        return f"a file cannot be opened ({error.strerror or error})"
    suffix = path.suffix.lower()
    if suffix == ".ply":
        lines = _of_ply(head)
    elif suffix == ".stl":
        lines = _of_stl(head, size)
    elif suffix in (".obj", ".off"):
        lines = _of_text(head)
    else:
        lines = [f"begins with the bytes {head[:_MAGIC_BYTES].hex(' ')}"]
    return FileHeader(format=suffix.removeprefix(".").upper(), size_bytes=size, lines=tuple(lines))


def _of_ply(head: bytes) -> list[str]:
    header, end, _ = head.partition(b"end_header")
    lines: list[str] = []
    for words in (line.split() for line in header.decode("utf-8", "replace").splitlines()):
        if words[:1] in (["comment"], ["obj_info"]):
            textured = words[1:2] == ["TextureFile"]
            lines.append(f"{words[0]} TextureFile (name)" if textured else f"{words[0]} (text)")
        elif words[:1] in (["ply"], ["format"], ["element"], ["property"]):
            lines.append(" ".join(words))
        elif words:
            lines.append("(another line)")
    return [*lines, "end_header" if end else "the header is cut short"]


def _of_stl(head: bytes, size: int) -> list[str]:
    if announced_bytes(head) == size:
        return [f"binary, {int.from_bytes(head[80:84], 'little')} triangles"]
    if head.lstrip().startswith(b"solid"):
        return ["solid (name)", *_of_text(head)[1:]]
    return [f"binary, {announced_bytes(head)} bytes announced"]


def _of_text(head: bytes) -> list[str]:
    """How many lines begin with each short word, with the number of words behind it."""
    counts = Counter[str]()
    for words in (line.split() for line in head.decode("utf-8", "replace").splitlines()):
        if words and words[0].startswith("#"):
            counts["# (text)"] += 1
        elif words and words[0].isalpha() and words[0] in _WORDS:
            numbers = _is_numbers(words[1:])
            counts[f"{words[0]} with {len(words) - 1} {numbers}"] += 1
        elif words:
            counts[f"{len(words)} {_is_numbers(words)}"] += 1
    return [f"{line} ({count} times in {len(head)} bytes)" for line, count in counts.most_common()]


def _is_numbers(words: list[str]) -> str:
    return "numbers" if all(word.strip("-+.0123456789eE/") == "" for word in words) else "words"
