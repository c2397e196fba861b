"""Text of foreign programs: its encoding is not stated, its lines end in three ways, and its names may be in any."""

from __future__ import annotations

import codecs
import os
import re
import unicodedata
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Of names that are not UTF-8: Western Europe, Japan, China, Korea, Taiwan, Central Europe, Russia, DOS, macOS.
_LEGACY = (
    "cp1252", "cp932", "gb18030", "cp949", "big5", "cp1250", "cp1251", "cp850", "cp437", "mac_roman", "latin-1",
)  # fmt: skip
_BLOCK_BYTES = 1 << 24
_SHOWN = 64  # most bytes of a word in an error
_UTF16 = ((codecs.BOM_UTF16_LE, "utf-16-le"), (codecs.BOM_UTF16_BE, "utf-16-be"))
# A line that goes on after a backslash. Not any line does: a comment may end with a folder's name, and the second
# byte of a character of Shift-JIS may be a backslash.
_GOES_ON = re.compile(rb"^(?:v|vn|vt|vp|f|l|p) [^\n]*(?<![\x80-\xff])\\ *\n(?:[^\n]*\\ *\n)*", re.MULTILINE)


def readings(raw: bytes) -> tuple[str, ...]:
    """What bytes may mean as text, the most probable first: UTF-8 if they are, else by each legacy encoding."""
    found: dict[str, None] = {}
    for encoding in ("utf-8", *_LEGACY):
        try:
            found[raw.decode(encoding)] = None
        except UnicodeDecodeError:
            continue
        if encoding == "utf-8":
            break
    return tuple(found)


def name_of(path: Path) -> str:
    """The name of a file as text that can be written down, also if it is not UTF-8 on the disk."""
    return readings(os.fsencode(path.name))[0]


def alike(name: str) -> str:
    """The same for names that differ in case, or in how accents are composed (macOS takes them apart)."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


def logical_lines(path: Path) -> Iterator[bytes]:
    """The text of a file in blocks of whole lines, as other programs' writers never agree to write it.

    Lines end with a newline, also the last one; they are not indented and have no tabs; one that goes on after a
    backslash is a single one. Bytes that are not ASCII stay as they are, but for UTF-16, which becomes UTF-8.
    """
    with path.open("rb") as stream:
        head = stream.read(4)
        stream.seek(0)
        encoding = next((name for bom, name in _UTF16 if head.startswith(bom)), "")
        if not encoding and len(head) == 4 and head.count(b"\0") == 2:
            encoding = "utf-16-le" if head[1] == 0 else "utf-16-be"
        decoder = codecs.getincrementaldecoder(encoding)("replace") if encoding else None
        rest = b""
        first = True
        while chunk := stream.read(_BLOCK_BYTES):
            if decoder is not None:
                chunk = decoder.decode(chunk).encode()
            if first:
                chunk, first = chunk.removeprefix(codecs.BOM_UTF8), False
            chunk = (rest + chunk).replace(b"\t", b" ")
            # A return at the end may belong to a newline that comes next.
            held = b"\r" if chunk.endswith(b"\r") else b""
            chunk = chunk.removesuffix(b"\r").replace(b"\r\n", b"\n").replace(b"\r", b"\n")
            end = chunk.rfind(b"\n") + 1
            while end and chunk[:end].rstrip(b" \n").endswith(b"\\"):
                end = chunk.rfind(b"\n", 0, end - 1) + 1
            rest = chunk[end:] + held
            if end:
                yield _plain(chunk[:end])
        if rest.strip():
            yield _plain(rest.replace(b"\r", b"\n").rstrip(b"\n") + b"\n")


def _plain(block: bytes) -> bytes:
    """Whole lines without indentation, and joined where they go on."""
    if block.startswith(b" ") or b"\n " in block:
        block = re.sub(rb"^ +", b"", block, flags=re.MULTILINE)
    if b"\\" in block:
        block = _GOES_ON.sub(lambda lines: re.sub(rb"\\ *\n", b" ", lines[0]), block)
    return block


def numbers(
    text: bytes, kind: type[np.float64] | type[np.int64] = np.float64, count: int | None = None
) -> NDArray[Any]:
    """The words of a text as numbers (N,); `count` is how many words there are, if it is known.

    Raises ValueError with the first that is none.
    """
    count = len(text.split()) if count is None else count
    if count == 0:
        return np.empty(0, dtype=kind)
    try:
        values = np.fromstring(text, dtype=kind, sep=" ")
    except (ValueError, DeprecationWarning):  # NumPy 2.3 and older warn
        values = np.empty(0, dtype=kind)
    if len(values) == count:  # 1-2 would be taken for two numbers
        return values
    words = text.split()
    wrong = next((word for word in words if not is_number(word, kind)), words[0])
    shown = readings(wrong[:_SHOWN])[0]
    comma = " (a decimal comma)" if re.fullmatch(r"[-+]?\d+,\d+(e[-+]?\d+)?", shown, re.IGNORECASE) else ""
    raise ValueError(f"{shown!r} is not a number{comma}")


def is_number(word: bytes, kind: type[np.float64] | type[np.int64] = np.float64) -> bool:
    """Return whether `numbers` takes a word for a number."""
    try:
        kind(word)
    except (ValueError, OverflowError):
        return False
    return b"_" not in word
