"""Just enough of each wire protocol to split it into messages, name their kinds, and refuse in the device's words."""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from typing import ClassVar, Protocol

Message = tuple[str, bytes]  # kind and bytes; an empty kind is always passed on


class Framer(Protocol):
    """Splits one direction of a connection into messages."""

    def feed(self, data: bytes) -> list[Message]:
        """Add bytes; returns the messages that are now complete."""
        ...

    def rest(self) -> bytes:
        """Return the remaining bytes, to be passed on unchanged because nothing followed them."""
        ...


class _Buffered:
    def __init__(self) -> None:
        self._buffer = b""

    def rest(self) -> bytes:
        """Return the remaining bytes."""
        left, self._buffer = self._buffer, b""
        return left


class _Sized(_Buffered, ABC):
    """Messages whose first bytes state their size."""

    shortest: ClassVar[int]  # bytes of a header, which no message is shorter than

    def feed(self, data: bytes) -> list[Message]:
        """Add bytes; returns the messages that are now complete."""
        self._buffer += data
        found: list[Message] = []
        while len(self._buffer) >= self.shortest:
            size = self._size(self._buffer)
            if size < self.shortest or len(self._buffer) < size:
                break
            message, self._buffer = self._buffer[:size], self._buffer[size:]
            found.append((self._kind(message), message))
        return found

    @abstractmethod
    def _size(self, header: bytes) -> int:
        """Bytes of the message that begins with this header, the header included."""

    @abstractmethod
    def _kind(self, message: bytes) -> str: ...


_RTDE_ANSWERS = {
    "V": "version",
    "v": "controller",
    "O": "outputs",
    "I": "inputs",
    "S": "start",
    "P": "pause",
    "U": "stream",
}


class Rtde(_Sized):
    """RTDE frames of port 30004: size with header (big-endian u16), type, payload."""

    shortest = 3

    def __init__(self, *, answers: bool) -> None:
        super().__init__()
        self._answers = answers

    def _size(self, header: bytes) -> int:
        return int.from_bytes(header[:2], "big")

    def _kind(self, message: bytes) -> str:
        kind = _RTDE_ANSWERS.get(chr(message[2]), "")
        if self._answers:
            return kind
        return "command" if kind == "stream" else ""


class Lines(_Buffered):
    """Lines of a dashboard or a light box; `kinds` maps their lower-case first word to a kind."""

    def __init__(self, kinds: dict[str, str], otherwise: str = "") -> None:
        super().__init__()
        self._kinds, self._otherwise = kinds, otherwise

    def feed(self, data: bytes) -> list[Message]:
        """Add bytes; returns the lines that are now complete."""
        *whole, self._buffer = (self._buffer + data).split(b"\n")
        found: list[Message] = []
        for line in whole:
            word = line.split(b" ")[0].strip().decode("ascii", "replace").lower()
            found.append((self._kinds.get(word, self._otherwise), line + b"\n"))
        return found


_GRBL = {b"<": "status", b"$": "setting", b"G": "welcome", b"o": "answer", b"e": "answer"}  # by the first letter
_AT_ONCE = b"\x18?!~\x85"  # commands of one byte


class Talk:
    """The current operation of a connection, after which its answers are named."""

    def __init__(self) -> None:
        self.operation = ""


class Grbl(_Buffered):
    """GRBL's lines, and the commands of one byte between them; the answer to homing has a name of its own."""

    def __init__(self, talk: Talk, *, answers: bool) -> None:
        super().__init__()
        self._talk, self._answers = talk, answers

    def feed(self, data: bytes) -> list[Message]:
        """Add bytes; returns the lines and commands that are now complete."""
        found: list[Message] = []
        for byte in data:
            one = bytes([byte])
            if not self._answers and one in _AT_ONCE:
                found.append(("query" if one == b"?" else "reset" if one == b"\x18" else "hold", one))
                continue
            self._buffer += one
            if one == b"\n":
                found.append((self._kind(self._buffer), self._buffer))
                self._buffer = b""
        return found

    def _kind(self, line: bytes) -> str:
        if self._answers:
            kind = _GRBL.get(line[:1], "")
            if kind == "welcome":
                self._talk.operation = ""
            if kind == "answer" and self._talk.operation == "home":
                self._talk.operation, kind = "", "homed"
            return kind
        self._talk.operation = "home" if line.startswith(b"$H") else ""
        return "jog" if line.startswith(b"$J=") else self._talk.operation or "line"


class JsonLines(_Buffered):
    """Lines of JSON of the KUKA wire; those of the controller are named after their field `is`."""

    def __init__(self, *, answers: bool) -> None:
        super().__init__()
        self._answers = answers

    def feed(self, data: bytes) -> list[Message]:
        """Add bytes; returns the lines that are now complete."""
        *whole, self._buffer = (self._buffer + data).split(b"\n")
        return [(self._kind(line), line + b"\n") for line in whole]

    def _kind(self, line: bytes) -> str:
        if not self._answers:
            return "beat" if b'"beat"' in line else "request"
        return next((kind for kind in ("state", "hello", "ack", "done") if f'"is":"{kind}"'.encode() in line), "")


class Script(_Buffered):
    """Programs of the script port: each ends with an unindented line `end`."""

    def feed(self, data: bytes) -> list[Message]:
        """Add bytes; returns the programs that are now complete."""
        self._buffer += data
        found: list[Message] = []
        while (at := self._buffer.find(b"\nend\n")) >= 0:
            cut = at + len(b"\nend\n")
            found.append(("script", self._buffer[:cut]))
            self._buffer = self._buffer[cut:]
        return found


REQUEST, RESPONSE, EVENT, START_DATA, DATA, END_DATA = 6, 7, 8, 9, 10, 12
_OPERATIONS = {
    0x1001: "device_info",
    0x1002: "session",
    0x1008: "file_info",
    0x1009: "file",
    0x9110: "eos_set",
    0x9114: "remote_mode",
    0x9115: "event_mode",
    0x9116: "events",
    0x9128: "press",
    0x9129: "let_go",
    0x9205: "set",
    0x9207: "release",
    0x9209: "properties",
}


class PtpIp(_Sized):
    """PTP/IP packets: length with header, type (little-endian u32 each), body.

    An answer without data is named after its operation, and so is each data packet of an answer with data.
    """

    shortest = 8

    def __init__(self, talk: Talk, *, answers: bool) -> None:
        super().__init__()
        self._talk, self._answers = talk, answers
        self._with_data = False

    def _size(self, header: bytes) -> int:
        return int.from_bytes(header[:4], "little")

    def _kind(self, message: bytes) -> str:
        kind = int.from_bytes(message[4:8], "little")
        if not self._answers:
            if kind == REQUEST:
                self._talk.operation = _OPERATIONS.get(struct.unpack_from("<H", message, 12)[0], "")
                return "request"
            return ""
        if kind in (START_DATA, DATA, END_DATA):
            self._with_data = True
            return self._talk.operation
        if kind == RESPONSE:
            with_data, self._with_data = self._with_data, False
            return "" if with_data else self._talk.operation
        return {2: "connect", 4: "event_connect", EVENT: "event"}.get(kind, "")


_PDUS = {1: "associate", 2: "accept", 5: "release", 6: "released"}


class Dicom(_Sized):
    """PDUs of DICOM's upper layer: type, a byte, length (big-endian u32), content; data are named by their kind."""

    shortest = 6

    def __init__(self, *, answers: bool) -> None:
        super().__init__()
        self._answers = answers

    def _size(self, header: bytes) -> int:
        return 6 + int.from_bytes(header[2:6], "big")

    def _kind(self, message: bytes) -> str:
        if message[0] != 4 or len(message) < 12:
            return _PDUS.get(message[0], "")
        if self._answers:
            return "stored"
        return "command" if message[11] & 1 else "slice"


# --- saying no ------------------------------------------------------------------------------------------------

_ACCESS_DENIED = 0x200F


def refused(device: str, kind: str, message: bytes) -> bytes:  # noqa: PLR0911 - one for each device
    """The message with which this device refuses a request. Raises KeyError if the device cannot refuse it."""
    if device == "camera":
        if kind in ("connect", "event_connect"):
            return struct.pack("<III", 12, 5, 1)
        if struct.unpack_from("<I", message, 4)[0] == RESPONSE:
            return message[:8] + struct.pack("<H", _ACCESS_DENIED) + message[10:14] + bytes(len(message) - 14)
        raise KeyError(kind)
    if device == "ct":
        if kind == "accept":
            return bytes([3, 0, 0, 0, 0, 4, 0, 1, 1, 1])
        status = bytes.fromhex("0000000902000000")  # (0000,0900), two bytes
        at = message.index(status) + len(status)
        return message[:at] + b"\x00\xa7" + message[at + 2 :]
    if device == "gige":
        return b"\x80\x06" + message[2:4] + b"\0\0" + message[6:8]  # access denied
    if device == "lightbox":
        return b"ERR 2 refused\r\n"
    if device == "table":
        return {"answer": b"error:9\r\n", "homed": b"error:5\r\n", "setting": b"error:8\r\n"}[kind]
    if device == "kuka":
        if kind == "hello":
            return b'{"is":"err","seq":null,"motion":null,"code":"taken","what":"another client is connected"}\n'
        sequence = b"" if kind != "ack" else message.split(b'"seq":')[1].split(b",")[0].strip(b"}\n")
        return b'{"is":"err","seq":%s,"motion":null,"code":"failed","what":"refused"}\n' % (sequence or b"null")
    if kind == "answer":
        return b"could not understand: ''\n"
    payload = {"version": b"\0", "start": b"\0", "outputs": b"\0NOT_FOUND", "inputs": b"\0IN_USE"}[kind]
    return struct.pack(">HB", 3 + len(payload), message[2]) + payload


def denied(transaction: bytes) -> bytes:
    """The response that replaces a camera's data; `transaction` is the little-endian transaction number (4 bytes)."""
    return struct.pack("<IIH", 14, RESPONSE, _ACCESS_DENIED) + transaction
