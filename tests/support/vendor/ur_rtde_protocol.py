"""A small RTDE client written from Universal Robots' guide, speaking like their own Python client."""

from __future__ import annotations

import socket
import struct

UR_TYPES = {
    "DOUBLE": "d",
    "UINT32": "I",
    "INT32": "i",
    "UINT64": "Q",
    "UINT8": "B",
    "BOOL": "?",
    "VECTOR3D": "ddd",
    "VECTOR6D": "dddddd",
    "VECTOR6INT32": "iiiiii",
    "VECTOR6UINT32": "IIIIII",
}


class RtdeClient:
    """Protocol version 2 over one connection."""

    def __init__(self, host: str, timeout_s: float = 90.0) -> None:
        self.socket = socket.create_connection((host, 30004), timeout=timeout_s)
        self._buffer = b""
        self._formats: dict[int, tuple[list[str], list[str]]] = {}

    def close(self) -> None:
        self.socket.close()

    def shutdown(self) -> None:
        """Shut the connection down under a thread that waits for data, in which this raises OSError."""
        self.socket.shutdown(socket.SHUT_RDWR)

    def send(self, kind: str, payload: bytes = b"") -> None:
        self.socket.sendall(struct.pack(">HB", len(payload) + 3, ord(kind)) + payload)

    def receive(self) -> tuple[str, bytes]:
        while len(self._buffer) < 3 or len(self._buffer) < struct.unpack(">H", self._buffer[:2])[0]:
            data = self.socket.recv(65536)
            if not data:
                raise ConnectionResetError("the controller closed the connection")
            self._buffer += data
        size = struct.unpack(">H", self._buffer[:2])[0]
        message, self._buffer = self._buffer[:size], self._buffer[size:]
        return chr(message[2]), message[3:]

    def ask(self, kind: str, payload: bytes = b"") -> bytes:
        """Send and wait for the reply of the same kind; data packages in between are dropped."""
        self.send(kind, payload)
        while True:
            got, reply = self.receive()
            if got == kind:
                return reply

    def answered_by(self, kind: str) -> str:
        """Send a request, and return the kind of the message that comes next."""
        self.send(kind)
        return self.receive()[0]

    def negotiate(self, version: int = 2) -> bool:
        return self.ask("V", struct.pack(">H", version)) == b"\x01"

    def controller_version(self) -> tuple[int, ...]:
        return struct.unpack(">IIII", self.ask("v"))

    def output_setup(self, names: list[str], frequency_hz: float) -> tuple[int, list[str]]:
        reply = self.ask("O", struct.pack(">d", frequency_hz) + ",".join(names).encode())
        types = reply[1:].decode().split(",")
        self._formats[reply[0]] = (names, types)
        return reply[0], types

    def input_setup(self, names: list[str]) -> tuple[int, list[str]]:
        reply = self.ask("I", ",".join(names).encode())
        return reply[0], reply[1:].decode().split(",")

    def start(self) -> bool:
        return self.ask("S") == b"\x01"

    def pause(self) -> bool:
        return self.ask("P") == b"\x01"

    def data(self) -> dict[str, tuple[float, ...]]:
        """The next data package."""
        while True:
            kind, payload = self.receive()
            if kind == "U":
                break
        names, types = self._formats[payload[0]]
        values = struct.unpack(">" + "".join(UR_TYPES[t] for t in types), payload[1:])
        fields: dict[str, tuple[float, ...]] = {}
        for name, kind in zip(names, types, strict=True):
            fields[name], values = values[: len(UR_TYPES[kind])], values[len(UR_TYPES[kind]) :]
        return fields
