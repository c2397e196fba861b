"""What the listening process tells the driver about each message: a record of fixed size."""

from __future__ import annotations

import struct
from dataclasses import astuple, dataclass

from drivers.kuka.fri.wire import JOINTS, Quality, Session

_RECORD = struct.Struct(f"<dd{JOINTS}d{JOINTS}d???BBHIII")
SIZE = _RECORD.size


@dataclass(frozen=True, slots=True)
class FriSample:
    """The arm at one moment, and the state of the connection.

    Attributes:
        monotonic_s: host time.monotonic() when the datagram arrived.
        time_s: the controller's clock, seconds since 1970.
        joints_rad: (7,) measured.
        commanded_rad: (7,) commanded; None if FRI does not tell.
        is_normal: whether the safety controller reports no stop.
        session: state of the session.
        quality: how punctual the controller finds the replies.
        period_ms: the controller's time between two messages.
        received: messages so far.
        lost: messages so far that never came.
        refused: datagrams so far that were not messages of this controller.
    """

    monotonic_s: float
    time_s: float
    joints_rad: tuple[float, ...]
    commanded_rad: tuple[float, ...] | None
    is_normal: bool
    session: Session
    quality: Quality
    period_ms: int
    received: int
    lost: int
    refused: int

    def pack(self) -> bytes:
        """The record as SIZE bytes."""
        monotonic_s, time_s, joints, commanded, normal, *rest = astuple(self)
        known = commanded is not None
        return _RECORD.pack(
            monotonic_s, time_s, *(joints or (0.0,) * JOINTS), *(commanded or (0.0,) * JOINTS), bool(joints), known,
            normal, *rest,
        )  # fmt: skip


def unpack(record: bytes) -> FriSample:
    """The record of SIZE bytes."""
    values = _RECORD.unpack(record)
    has_joints, known, normal, session, quality, period_ms, received, lost, refused = values[2 + 2 * JOINTS :]
    return FriSample(
        monotonic_s=values[0],
        time_s=values[1],
        joints_rad=values[2 : 2 + JOINTS] if has_joints else (),
        commanded_rad=values[2 + JOINTS : 2 + 2 * JOINTS] if known else None,
        is_normal=normal,
        session=Session(session),
        quality=Quality(quality),
        period_ms=period_ms,
        received=received,
        lost=lost,
        refused=refused,
    )
