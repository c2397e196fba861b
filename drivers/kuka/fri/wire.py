"""FRI's messages as records: those of the controller decoded, and the reply that keeps the session alive.

The reply has a header and nothing else: without data it commands nothing. FRI 2.7 puts a length before each message
and a CRC-32 behind it; which form a controller speaks shows in its messages.
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass
from enum import IntEnum

from drivers.kuka.fri.protobuf import ProtobufError, doubles, fields, message_field, number_field

JOINTS = 7
_MONITORING, _REPLY = 0x245142, 0x34001  # identifiers of the messages of an LBR
_FRAME = struct.Struct("<I")
_COUNTERS, _LONGEST_PERIOD_MS = 1 << 32, 1 << 16
_FULL_TURN = 2 * math.pi  # more than any joint of an LBR turns


class FriError(ValueError):
    """A datagram that is not a monitor message of FRI; the text says why."""


class Session(IntEnum):
    """State of the session. A client could command only in the last two; this one does not answer in them."""

    IDLE = 0
    MONITORING_WAIT = 1
    MONITORING_READY = 2
    COMMANDING_WAIT = 3
    COMMANDING_ACTIVE = 4


class Quality(IntEnum):
    """How punctual the controller finds the replies."""

    POOR = 0
    FAIR = 1
    GOOD = 2
    EXCELLENT = 3


@dataclass(frozen=True, slots=True)
class Monitoring:
    """One message of the controller.

    Attributes:
        framed: whether it came with length and CRC-32, as from FRI 2.7.
        sequence: counts the messages, modulo 2³².
        reflected: the counter of the last reply that the controller has seen.
        answer_every: the controller wants a reply to each so many messages.
        joints_rad: (7,) measured.
        commanded_rad: (7,) commanded; None from FRI 2 on.
        time_s: the controller's clock, seconds since 1970.
        is_normal: whether the safety controller reports no stop.
    """

    framed: bool
    sequence: int
    reflected: int
    session: Session
    quality: Quality
    period_ms: int
    answer_every: int
    joints_rad: tuple[float, ...]
    commanded_rad: tuple[float, ...] | None
    time_s: float
    is_normal: bool


def decode(datagram: bytes) -> Monitoring:
    """Decode a datagram of the controller. Raises FriError."""
    try:
        message, framed = _unframed(datagram)
        parts = _parts(message)
        header = _numbers(parts, 1)
        if header.get(1) != _MONITORING:
            raise FriError(f"the message is {header.get(1, 0):#x}, not one of an LBR ({_MONITORING:#x})")
        robot, connection = _numbers(parts, 2), _numbers(parts, 4)
        monitor = _parts(parts.get(3, b""))
        commanded = doubles(monitor[3], 1) if 3 in monitor else None
        joints = doubles(monitor.get(1, b""), 1)
        stamp = _numbers(monitor, 15)
        sequence, period_ms = header.get(2, 0), connection.get(3, 0)
        session, quality = Session(connection.get(1, 0)), Quality(connection.get(2, 0))
    except (ProtobufError, ValueError) as error:
        raise error if isinstance(error, FriError) else FriError(str(error)) from error
    if sequence >= _COUNTERS or period_ms >= _LONGEST_PERIOD_MS:
        raise FriError(f"the message has the number {sequence} and the period {period_ms} ms")
    if not all(abs(q) <= _FULL_TURN for q in (*joints, *(commanded or ()))):  # NaN is none either
        raise FriError(f"the message has joints that no arm has: {joints}")
    if session is not Session.IDLE and (len(joints) != JOINTS or 1 not in stamp):
        raise FriError(f"the message has {len(joints)} joints and {'a' if stamp else 'no'} time")
    return Monitoring(
        framed=framed,
        sequence=sequence,
        reflected=header.get(3, 0),
        session=session,
        quality=quality,
        period_ms=period_ms,
        answer_every=max(1, connection.get(4, 1)),
        joints_rad=joints,
        commanded_rad=commanded if commanded and len(commanded) == JOINTS else None,
        time_s=stamp.get(1, 0) + 1e-9 * stamp.get(2, 0),
        is_normal=robot.get(2, 0) == 0,
    )


def reply(to: Monitoring, sequence: int) -> bytes:
    """The datagram that tells the controller that its message arrived; it commands nothing."""
    header = number_field(1, _REPLY) + number_field(2, sequence) + number_field(3, to.sequence)
    message = message_field(1, header)
    if not to.framed:
        return message
    return _FRAME.pack(len(message)) + message + _FRAME.pack(zlib.crc32(message))


def _unframed(datagram: bytes) -> tuple[bytes, bool]:
    """The message of a datagram, and whether it was framed: a bare one begins with the tag of its header."""
    overhead = 2 * _FRAME.size
    if len(datagram) < overhead or _FRAME.unpack_from(datagram)[0] != len(datagram) - overhead:
        return datagram, False
    message = datagram[_FRAME.size : -_FRAME.size]
    if _FRAME.unpack(datagram[-_FRAME.size :])[0] != zlib.crc32(message):
        raise FriError("the checksum of the message is wrong")
    return message, True


def _parts(message: bytes) -> dict[int, bytes]:
    """The messages within a message, by number; the last one counts."""
    return {number: value for number, value in fields(message) if isinstance(value, bytes)}


def _numbers(parts: dict[int, bytes], number: int) -> dict[int, int]:
    """The numbers within one of the parts, by number."""
    return {field: value for field, value in fields(parts.get(number, b"")) if isinstance(value, int)}
