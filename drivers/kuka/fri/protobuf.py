"""The little of Google's protobuf encoding that FRI needs.

Source: https://protobuf.dev/programming-guides/encoding/
"""

from __future__ import annotations

import struct
from collections.abc import Iterator

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_LONGEST_VARINT = 10


class ProtobufError(ValueError):
    """Bytes that are not a protobuf message; the text says why."""


def fields(message: bytes) -> Iterator[tuple[int, int | bytes]]:
    """The fields of a message in their order: number and value.

    Varints are ints; fields with a length, and numbers of fixed width, are bytes. Raises ProtobufError.
    """
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        number, kind = key >> 3, key & 7
        if kind == _VARINT:
            value, at = _varint(message, at)
            yield number, value
            continue
        if kind == _BYTES:
            size, at = _varint(message, at)
        elif kind in (_FIXED64, _FIXED32):
            size = 8 if kind == _FIXED64 else 4
        else:
            raise ProtobufError(f"field {number} has the unknown wire type {kind}")
        if at + size > len(message):
            raise ProtobufError(f"field {number} is longer than the message")
        yield number, message[at : at + size]
        at += size


def doubles(message: bytes, number: int) -> tuple[float, ...]:
    """The values of a repeated double, packed or not. Raises ProtobufError."""
    found: list[float] = []
    for field, value in fields(message):
        if field != number:
            continue
        if not isinstance(value, bytes) or len(value) % 8:
            raise ProtobufError(f"field {number} is not a list of doubles")
        found.extend(struct.unpack(f"<{len(value) // 8}d", value))
    return tuple(found)


def varint(value: int) -> bytes:
    """A number that is not negative, seven bits a byte, the lowest first."""
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def number_field(number: int, value: int) -> bytes:
    """A field with a number that is not negative."""
    return varint(number << 3 | _VARINT) + varint(value)


def message_field(number: int, message: bytes) -> bytes:
    """A field with a message in it."""
    return varint(number << 3 | _BYTES) + varint(len(message)) + message


def _varint(message: bytes, at: int) -> tuple[int, int]:
    value = 0
    for index in range(_LONGEST_VARINT):
        if at + index >= len(message):
            raise ProtobufError("the message ends within a number")
        byte = message[at + index]
        value |= (byte & 0x7F) << 7 * index
        if byte < 0x80:
            return value, at + index + 1
    raise ProtobufError("a number has more than ten bytes")
