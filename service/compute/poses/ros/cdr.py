"""Common Data Representation (CDR), the encoding of ROS 2 messages: primitives, aligned, little- or big-endian.

Source: OMG, "Common Object Request Broker Architecture", part 2, 9.3; encapsulation as in OMG's DDSI-RTPS, 10.2.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

_LITTLE, _BIG = b"\0\1\0\0", b"\0\0\0\0"
_HEAD = 4  # bytes of the encapsulation, from whose end everything is aligned


class CdrError(ValueError):
    """The bytes are not a message of the expected type."""


class CdrWriter:
    """Encodes one message, little-endian."""

    def __init__(self) -> None:
        self._data = bytearray(_LITTLE)

    def bytes(self) -> bytes:
        """The encoded message."""
        return bytes(self._data)

    def number(self, code: str, value: float) -> None:
        """A number with a code of the module struct: i, I, d, …"""
        self._align(struct.calcsize(code))
        self._data += struct.pack(f"<{code}", value)

    def text(self, value: str) -> None:
        """A string, with its terminating zero."""
        encoded = value.encode() + b"\0"
        self.number("I", len(encoded))
        self._data += encoded

    def blob(self, value: bytes) -> None:
        """A sequence of bytes."""
        self.number("I", len(value))
        self._data += value

    def doubles(self, values: Sequence[float] | NDArray[np.float64], *, sequence: bool) -> None:
        """Doubles: an array of fixed length, or a sequence, which states its length."""
        if sequence:
            self.number("I", len(values))
        for value in values:
            self.number("d", float(value))

    def _align(self, size: int) -> None:
        self._data += bytes(-(len(self._data) - _HEAD) % size)


class CdrReader:
    """Decodes one message. Every method raises CdrError where the bytes end, or hold something else."""

    def __init__(self, data: bytes) -> None:
        if data[:2] not in (_LITTLE[:2], _BIG[:2]):
            raise CdrError(f"the message is not plain CDR (it begins with {data[:4].hex()})")
        self._order = "<" if data[:2] == _LITTLE[:2] else ">"
        self._data, self._at = data, _HEAD

    def integer(self, code: str) -> int:
        """A whole number with a code of the module struct."""
        return int(self._unpack(code, 1)[0])

    def doubles(self, count: int) -> NDArray[np.float64]:
        """(count,) doubles."""
        return np.array(self._unpack("d", count), dtype=np.float64)

    def text(self) -> str:
        """A string."""
        raw = self.blob()
        if not raw.endswith(b"\0"):
            raise CdrError("a string does not end with a zero")
        try:
            return raw[:-1].decode()
        except UnicodeDecodeError as error:
            raise CdrError("a string is not UTF-8") from error

    def blob(self) -> bytes:
        """A sequence of bytes."""
        return self._take(self.integer("I"))

    def sequence_length(self, least_bytes: int) -> int:
        """The length of a sequence whose elements take so many bytes at least."""
        count = self.integer("I")
        if count * least_bytes > len(self._data) - self._at:
            raise CdrError(f"a sequence of {count} elements does not fit into the message")
        return count

    def _unpack(self, code: str, count: int) -> tuple[float, ...]:
        size = struct.calcsize(code)
        self._at += -(self._at - _HEAD) % size
        return struct.unpack(f"{self._order}{count}{code}", self._take(count * size))

    def _take(self, size: int) -> bytes:
        if size > len(self._data) - self._at:
            raise CdrError("the message is cut short")
        self._at += size
        return self._data[self._at - size : self._at]
