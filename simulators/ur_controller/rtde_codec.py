"""RTDE frames as bytes, without sockets: u16 size including the header, u8 type, payload; all big-endian."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence

REQUEST_PROTOCOL_VERSION = ord("V")
GET_CONTROL_VERSION = ord("v")
DATA_PACKAGE = ord("U")
SETUP_OUTPUTS = ord("O")
SETUP_INPUTS = ord("I")
START = ord("S")
PAUSE = ord("P")

PROTOCOL_VERSION = 2
HEADER = struct.Struct(">HB")

# Field types of the RTDE guide and their struct formats.
FORMATS = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}
LENGTHS = {name: int(code[0]) if len(code) > 1 else 1 for name, code in FORMATS.items()}


class FrameError(ValueError):
    """The bytes are not an RTDE frame; the connection cannot be resynchronised."""


def frame(kind: int, payload: bytes = b"") -> bytes:
    """Build one frame."""
    return HEADER.pack(HEADER.size + len(payload), kind) + payload


class FrameReader:
    """Splits a byte stream into frames."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Add bytes; yield (type, payload) of each complete frame. Raises FrameError."""
        self._buffer += data
        while len(self._buffer) >= HEADER.size:
            size, kind = HEADER.unpack_from(self._buffer)
            if size < HEADER.size:
                raise FrameError(f"frame of {size} bytes")
            if len(self._buffer) < size:
                return
            payload = bytes(self._buffer[HEADER.size : size])
            del self._buffer[:size]
            yield kind, payload


class Recipe:
    """An ordered selection of fields, which packs and unpacks their data packages."""

    def __init__(self, number: int, names: Sequence[str], types: Sequence[str]) -> None:
        self.number = number
        self.names = tuple(names)
        self.types = tuple(types)
        self._struct = struct.Struct(">B" + "".join(FORMATS[t] for t in types))
        self._lengths = tuple(LENGTHS[t] for t in types)
        self._head = HEADER.pack(HEADER.size + self._struct.size, DATA_PACKAGE)

    def pack(self, flat: Sequence[float]) -> bytes:
        """Build a data package from the fields' numbers, with vectors flattened."""
        return self._head + self._struct.pack(self.number, *flat)

    def unpack(self, payload: bytes) -> dict[str, tuple[float, ...]]:
        """Unpack a payload that begins with the recipe's number into field name → numbers.

        Extra bytes are ignored, because ur_rtde sends such packages. Raises FrameError if the payload is too short.
        """
        if len(payload) < self._struct.size:
            raise FrameError(f"recipe {self.number} takes {self._struct.size} bytes, not {len(payload)}")
        flat = self._struct.unpack_from(payload)[1:]
        fields: dict[str, tuple[float, ...]] = {}
        at = 0
        for name, length in zip(self.names, self._lengths, strict=True):
            fields[name] = flat[at : at + length]
            at += length
        return fields


def parse_setup_outputs(payload: bytes) -> tuple[float, list[str]]:
    """Parse the frequency in Hz and the field names of an output set-up (protocol version 2). Raises FrameError."""
    if len(payload) < 8:
        raise FrameError("set-up of outputs without a frequency")
    (frequency_hz,) = struct.unpack_from(">d", payload)
    return float(frequency_hz), parse_names(payload[8:])


def parse_names(payload: bytes) -> list[str]:
    """Parse comma-separated field names."""
    return [name.strip() for name in payload.decode("ascii", "replace").split(",") if name.strip()]


def setup_reply(kind: int, number: int, types: Sequence[str]) -> bytes:
    """Build the answer to a set-up: the recipe's number (0: refused), and a type, NOT_FOUND or IN_USE per field."""
    return frame(kind, bytes([number]) + ",".join(types).encode())
