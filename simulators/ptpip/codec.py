"""PTP/IP as bytes: packets on the two sockets, and the PTP datasets in them."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum

HEADER_BYTES = 8
MAX_PACKET_BYTES = 1 << 26  # limit for a client, which sends settings and no pictures
DATA_CHUNK_BYTES = 1 << 20


class CodecError(Exception):
    """The bytes are not a valid PTP/IP packet or dataset."""


class PacketType(IntEnum):
    """Type field of a PTP/IP packet (CIPA DC-X005, table of packet types)."""

    INIT_COMMAND_REQUEST = 1
    INIT_COMMAND_ACK = 2
    INIT_EVENT_REQUEST = 3
    INIT_EVENT_ACK = 4
    INIT_FAIL = 5
    OPERATION_REQUEST = 6
    OPERATION_RESPONSE = 7
    EVENT = 8
    START_DATA = 9
    DATA = 10
    CANCEL = 11
    END_DATA = 12
    PROBE_REQUEST = 13
    PROBE_RESPONSE = 14


@dataclass(frozen=True, slots=True)
class InitCommand:
    """The first packet on the command socket."""

    guid: bytes
    name: str
    version: int


@dataclass(frozen=True, slots=True)
class Request:
    """One operation request; `sends_data` is true if a data phase of the client follows."""

    operation: int
    transaction: int
    parameters: tuple[int, ...]
    sends_data: bool


def packet(kind: PacketType, body: bytes = b"") -> bytes:
    """Build a packet: length (including the header), type, body."""
    return struct.pack("<II", HEADER_BYTES + len(body), kind) + body


def parse_header(header: bytes) -> tuple[PacketType, int]:
    """Parse a packet header; returns the type and the number of body bytes. Raises CodecError."""
    if len(header) != HEADER_BYTES:
        raise CodecError(f"a packet header has 8 bytes, not {len(header)}")
    length, kind = struct.unpack("<II", header)
    if not HEADER_BYTES <= length <= MAX_PACKET_BYTES:
        raise CodecError(f"a packet of {length} bytes is impossible")
    try:
        return PacketType(kind), length - HEADER_BYTES
    except ValueError as error:
        raise CodecError(f"packet type {kind} is unknown") from error


def parse_init_command(body: bytes) -> InitCommand:
    """Parse the GUID, the zero-terminated UTF-16 name and the version. Raises CodecError."""
    if len(body) < 16 + 2 + 4:
        raise CodecError(f"Init_Command_Request of {len(body)} bytes is too short")
    name = body[16:-4].decode("utf-16-le", errors="replace").rstrip("\0")
    return InitCommand(body[:16], name, struct.unpack("<I", body[-4:])[0])


def init_command_ack(session: int, guid: bytes, name: str) -> bytes:
    """Build the camera's answer on the command socket."""
    body = struct.pack("<I", session) + guid + (name + "\0").encode("utf-16-le") + struct.pack("<I", 0x00010000)
    return packet(PacketType.INIT_COMMAND_ACK, body)


def parse_init_event(body: bytes) -> int:
    """Parse the session number with which the event socket joins its command socket. Raises CodecError."""
    if len(body) < 4:
        raise CodecError("Init_Event_Request without a session number")
    return int(struct.unpack_from("<I", body)[0])


def parse_request(body: bytes) -> Request:
    """Parse an operation request. Raises CodecError."""
    if len(body) < 10 or (len(body) - 10) % 4 or len(body) > 10 + 5 * 4:
        raise CodecError(f"an operation request of {len(body)} bytes is impossible")
    phase, operation, transaction = struct.unpack_from("<IHI", body)
    parameters = struct.unpack_from(f"<{(len(body) - 10) // 4}I", body, 10)
    return Request(operation, transaction, tuple(parameters), phase == 2)


def parse_start_data(body: bytes) -> int:
    """Parse the announced number of bytes; the client sets only its low 32 bits. Raises CodecError."""
    if len(body) < 12:
        raise CodecError("Start_Data without a length")
    return int(struct.unpack_from("<IQ", body)[1]) & 0xFFFFFFFF


def response(code: int, transaction: int, parameters: Sequence[int] = ()) -> bytes:
    """Build the operation response that ends a transaction."""
    body = struct.pack(f"<HI{len(parameters)}I", code, transaction, *parameters)
    return packet(PacketType.OPERATION_RESPONSE, body)


def event(code: int, transaction: int, parameters: Sequence[int] = ()) -> bytes:
    """Build a packet for the event socket."""
    return packet(PacketType.EVENT, struct.pack(f"<HI{len(parameters)}I", code, transaction, *parameters))


def data_packets(
    transaction: int, payload: bytes, announced: int | None = None, chunk_bytes: int = DATA_CHUNK_BYTES
) -> Iterator[bytes]:
    """Yield Start_Data, Data…, End_Data for a payload.

    `announced` differs from its length only in a planned fault.
    """
    total = len(payload) if announced is None else announced
    yield packet(PacketType.START_DATA, struct.pack("<IQ", transaction, total))
    view = memoryview(payload)
    position = 0
    while len(payload) - position > chunk_bytes:
        yield packet(PacketType.DATA, struct.pack("<I", transaction) + view[position : position + chunk_bytes])
        position += chunk_bytes
    yield packet(PacketType.END_DATA, struct.pack("<I", transaction) + view[position:])


# --- datasets ------------------------------------------------------------------------------------------


def string(text: str) -> bytes:
    """Encode a PTP string: number of characters including the final zero, then UTF-16; a zero byte if empty."""
    if not text:
        return b"\0"
    encoded = (text + "\0").encode("utf-16-le")
    if len(encoded) // 2 > 255:
        raise CodecError("a PTP string holds 254 characters at most")
    return bytes([len(encoded) // 2]) + encoded


def array_u16(values: Sequence[int]) -> bytes:
    """Encode an array: u32 count, then the u16 values."""
    return struct.pack(f"<I{len(values)}H", len(values), *values)


def array_u32(values: Sequence[int]) -> bytes:
    """Encode an array: u32 count, then the u32 values."""
    return struct.pack(f"<I{len(values)}I", len(values), *values)


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """The camera's identity and supported operations: the answer to GetDeviceInfo."""

    manufacturer: str
    model: str
    firmware: str
    serial: str
    operations: tuple[int, ...]
    events: tuple[int, ...]
    properties: tuple[int, ...]
    image_formats: tuple[int, ...]
    vendor_extension: int
    vendor_description: str

    def encode(self) -> bytes:
        """Encode the DeviceInfo dataset (PIMA 15740, 5.5.1)."""
        return b"".join(
            (
                struct.pack("<HIH", 100, self.vendor_extension, 100),
                string(self.vendor_description),
                struct.pack("<H", 0),
                array_u16(self.operations),
                array_u16(self.events),
                array_u16(self.properties),
                array_u16(()),
                array_u16(self.image_formats),
                string(self.manufacturer),
                string(self.model),
                string(self.firmware),
                string(self.serial),
            )
        )


@dataclass(frozen=True, slots=True)
class ObjectInfo:
    """The answer to GetObjectInfo; `size_bytes` must equal the length of what GetObject sends."""

    storage: int
    format: int
    size_bytes: int
    width: int
    height: int
    name: str
    captured: str  # YYYYMMDDThhmmss
    parent: int = 0  # handle of the folder
    folder: bool = False

    def encode(self) -> bytes:
        """Encode the ObjectInfo dataset (PIMA 15740, 5.3.1)."""
        return b"".join(
            (
                struct.pack("<IHHI", self.storage, self.format, 0, self.size_bytes),
                struct.pack("<HIII", 0x3808, 0, 0, 0),
                struct.pack("<IIIIHII", self.width, self.height, 24, self.parent, int(self.folder), 0, 0),
                string(self.name),
                string(self.captured),
                string(self.captured),
                string(""),
            )
        )


@dataclass(frozen=True, slots=True)
class StorageInfo:
    """The storage space of the card."""

    capacity_bytes: int
    free_bytes: int
    free_images: int
    name: str

    def encode(self) -> bytes:
        """Encode the StorageInfo dataset (PIMA 15740, 5.6.1): removable RAM, DCF, read-write."""
        head = struct.pack("<HHHQQI", 4, 3, 0, self.capacity_bytes, self.free_bytes, self.free_images)
        return head + string(self.name) + string("")
