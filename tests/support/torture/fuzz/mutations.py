"""Mutations of valid files: hypothesis strategies over bytes, text and JSON trees."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from typing import Any

from hypothesis import strategies as st
from hypothesis.strategies import DrawFn, SearchStrategy

Mutation = Callable[[DrawFn, bytes], bytes]

LARGEST = 1 << 20  # size limit of a mutated input; seeds are smaller
_NUMBER = re.compile(rb"[-+]?[0-9]+(?:\.[0-9]+)?(?:[eE][-+]?[0-9]+)?")
_WORD = re.compile(rb"[A-Za-z_][A-Za-z_0-9]*")
_INTEGERS = (
    0,
    1,
    -1,
    0x7F,
    0x80,
    0xFF,
    0x7FFF,
    0xFFFF,
    0x7FFF_FFFF,
    0x8000_0000,
    0xFFFF_FFFF,
    1 << 40,
    (1 << 64) - 1,
)
_NUMBERS = (
    b"0", b"-1", b"1e999", b"-1e999", b"nan", b"NaN", b"Infinity", b"1e-320", b"9" * 400, b"9" * 5000,
    b"2147483648", b"-9223372036854775809", b"18446744073709551616", b"1_0", b"0x10", b"\xd9\xa3", b"", b"3 4",
)  # fmt: skip
_TOKENS = (
    b"\0", b"\r", b"\n", b"\t", b"\x1b[2J", b"\xff", b"\xed\xa0\x80", b"\xef\xbb\xbf", b"\xe2\x80\xa8", b'"\\ud800"',
    b"null", b"true", b"{}", b"[]", b'""', b"''", b",", b":", b"- ", b"&a [*a]", b"*a", b"!!python/name:os.system",
    b'"\\UFFFFFFFF"', b"%YAML 9.9\n---\n", b"<<: ", b"? ", b"|", b">", b"#", b"../../../etc/passwd", b"A" * 3000,
)  # fmt: skip
_NESTS = (b"[", b'{"a":', b"- ", b"(", b"<a>", b"{a: ", b"\x30\x80", b"\xfe\xff\x00\xe0\xff\xff\xff\xff")
_VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1.5, 2**31, 2**53 + 1, 10**400, 1e308, 5e-324, float("nan"), float("inf"), "", "\0",
    "\ud800", "\x1b[2J", "a" * 3000, "1", "../..", [], {}, [[]], [1, 2, 3], [[1.0] * 4] * 4, {"a": {"b": []}}, ["\0"],
)  # fmt: skip


# --- bytes ------------------------------------------------------------------------------------------------------


def _at(draw: DrawFn, data: bytes) -> int:
    return draw(st.integers(0, max(len(data) - 1, 0)))


def flip(draw: DrawFn, data: bytes) -> bytes:
    """Replace one byte."""
    at = _at(draw, data)
    return data[:at] + bytes([draw(st.integers(0, 255))]) + data[at + 1 :]


def integer(draw: DrawFn, data: bytes) -> bytes:
    """Replace a count, size or offset by a boundary value of its field."""
    at, width = _at(draw, data), draw(st.sampled_from((1, 2, 4, 8)))
    value = draw(st.sampled_from(_INTEGERS)) & ((1 << 8 * width) - 1)
    order = draw(st.sampled_from(("little", "big")))
    return data[:at] + value.to_bytes(width, "big" if order == "big" else "little") + data[at + width :]


def cut(draw: DrawFn, data: bytes) -> bytes:
    """Truncate the end."""
    return data[: draw(st.integers(0, len(data)))]


def remove(draw: DrawFn, data: bytes) -> bytes:
    """Remove a part from within."""
    at = _at(draw, data)
    return data[:at] + data[at + draw(st.integers(1, 64)) :]


def again(draw: DrawFn, data: bytes) -> bytes:
    """Repeat a part."""
    at, length, times = _at(draw, data), draw(st.integers(1, 64)), draw(st.sampled_from((2, 3, 100, 1000)))
    return data[:at] + data[at : at + length] * times + data[at + length :]


def token(draw: DrawFn, data: bytes) -> bytes:
    """Insert something that often breaks parsers."""
    at = _at(draw, data)
    return data[:at] + draw(st.sampled_from(_TOKENS)) + data[at:]


def nest(draw: DrawFn, data: bytes) -> bytes:
    """Insert deeply nested brackets."""
    at, depth = _at(draw, data), draw(st.sampled_from((60, 900, 990, 2_000, 30_000)))
    return data[:at] + draw(st.sampled_from(_NESTS)) * depth + data[at:]


BYTES: tuple[Mutation, ...] = (flip, integer, cut, remove, again, token, nest)


# --- text -------------------------------------------------------------------------------------------------------


def number(draw: DrawFn, data: bytes) -> bytes:
    """Replace a number in the text by an impossible one, or by something that is not a number."""
    found = list(_NUMBER.finditer(data, 0, 1 << 16))
    if not found:
        return token(draw, data)
    match = found[draw(st.integers(0, len(found) - 1))]
    return data[: match.start()] + draw(st.sampled_from(_NUMBERS)) + data[match.end() :]


def word(draw: DrawFn, data: bytes) -> bytes:
    """Replace a word by another word of the file, or by something strange."""
    found = list(_WORD.finditer(data, 0, 1 << 16))
    if not found:
        return token(draw, data)
    match, other = (found[draw(st.integers(0, len(found) - 1))] for _ in range(2))
    new = draw(st.sampled_from((other.group(), *_TOKENS)))
    return data[: match.start()] + new + data[match.end() :]


def line(draw: DrawFn, data: bytes) -> bytes:
    """Remove, repeat or move a line."""
    lines = data.split(b"\n")
    at, to = (draw(st.integers(0, len(lines) - 1)) for _ in range(2))
    what = draw(st.sampled_from(("missing", "twice", "elsewhere")))
    moved = lines[at]
    if what != "twice":
        del lines[at]
    if what != "missing":
        lines.insert(to, moved)
    return b"\n".join(lines)


TEXT: tuple[Mutation, ...] = (*BYTES, number, word, line, number, word)


# --- JSON -------------------------------------------------------------------------------------------------------


def tree(draw: DrawFn, data: bytes) -> bytes:
    """Replace or remove a value within a JSON document (or one line of several), or duplicate its key."""
    lines = data.split(b"\n")
    at = draw(st.integers(0, len(lines) - 1)) if _is_lines(lines) else -1
    try:
        document = json.loads(data if at < 0 else lines[at])
    except (ValueError, RecursionError):
        return token(draw, data)
    changed = _changed(draw, document)
    if at < 0:
        return changed
    lines[at] = changed
    return b"\n".join(lines)


def _is_lines(lines: Sequence[bytes]) -> bool:
    return len(lines) > 1 and lines[0].startswith(b"{") and lines[0].endswith(b"}")


def _changed(draw: DrawFn, document: Any) -> bytes:
    places: list[tuple[Any, Any]] = []
    todo = [document]
    while todo and len(places) < 3000:
        here = todo.pop()
        children = here.items() if isinstance(here, dict) else enumerate(here) if isinstance(here, list) else ()
        for name, value in children:
            places.append((here, name))
            todo.append(value)
    what = draw(st.sampled_from(("value", "value", "missing", "more", "twice")))
    if not places:
        return _dumped(draw(st.sampled_from(_VALUES)))
    holder, name = places[draw(st.integers(0, len(places) - 1))]
    if what == "missing":
        del holder[name]
    elif what == "more" and isinstance(holder, dict):
        holder[draw(st.sampled_from(("x", "", "\0", "__proto__")))] = holder[name]
    elif what == "twice" and isinstance(holder, dict):
        text = _dumped(document)
        pair = json.dumps(str(name)).encode() + b": 1, "
        at = text.find(json.dumps(str(name)).encode())
        return text[:at] + pair + text[at:] if at >= 0 else text
    else:
        holder[name] = draw(st.sampled_from(_VALUES))
    return _dumped(document)


def _dumped(value: Any) -> bytes:
    if value == 10**400:
        return b"1" + b"0" * 400
    return json.dumps(value, default=str).encode()


JSON: tuple[Mutation, ...] = (*TEXT, tree, tree, tree, tree)


def mutated(seeds: Sequence[bytes], mutations: Sequence[Mutation]) -> SearchStrategy[bytes]:
    """One of the seeds with one to five mutations, occasionally spliced with another seed."""

    @st.composite
    def build(draw: DrawFn) -> bytes:
        data = draw(st.sampled_from(seeds))
        if len(seeds) > 1 and draw(st.integers(0, 15)) == 0:
            other = draw(st.sampled_from(seeds))
            data = data[: draw(st.integers(0, len(data)))] + other[draw(st.integers(0, len(other))) :]
        for _ in range(draw(st.integers(1, 5))):
            data = draw(st.sampled_from(mutations))(draw, data)[:LARGEST]
        return data

    return build()
