"""The controller's end of FRI: sends monitor messages over UDP, and judges the session by the replies.

Written from the message definitions of KUKA's client SDKs 1.15, 2.5 and 2.7; 3.0 exists, and its messages were not
at hand. An arm that no application commands through FRI never leaves the monitoring states, but for IDLE: that is the
last that a client hears of a session whose application ended (lbr_fri_ros2_stack#251).
"""

from __future__ import annotations

import logging
import socket
import struct
import time
import zlib
from collections import deque

from simulators.kuka_controller.controller import Controller
from simulators.units import ms

_LOG = logging.getLogger(__name__)

VERSIONS = ("1", "2.5", "2.7")
_MONITOR_ID, _COMMAND_ID = 2380098, 212993
_IDLE, _WAIT, _READY = 0, 1, 2
_JUDGED = 20  # messages by whose replies the quality is judged
_LATEST = 5  # a reply may come so many messages later
_MODES = {"T1": 0, "T2": 1, "AUT": 2}


class Session:
    """One session: `send` is called once a cycle."""

    def __init__(
        self, controller: Controller, source: str, client: tuple[str, int], version: str, cycles: int
    ) -> None:
        self._controller, self._client, self._version, self._cycles = controller, client, version, cycles
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((source, 0))
        self._socket.setblocking(False)
        self._cycle = self._counter = self._reflected = 0
        self._answered: deque[bool] = deque(maxlen=_JUDGED)
        self._replied_to: set[int] = set()
        self._period_ms = 0
        self.dead = False

    def send(self, period_s: float) -> None:
        """Take the replies, and send a message if one is due in this cycle."""
        self._take()
        self._cycle += 1
        if self._cycle % self._cycles or self.dead:
            return
        if self._counter > _LATEST:
            judged = self._counter - _LATEST
            self._answered.append(judged in self._replied_to)
            self._replied_to.discard(judged)
        self._counter += 1
        fault = self._controller.faults.check(self._controller.device, "fri")
        if fault is not None and fault.kind == "drop":
            return
        self._period_ms = round(ms(period_s)) * self._cycles
        if fault is not None and fault.kind == "end":
            self._end()
            return
        message = self._message(_READY if self.quality >= 2 else _WAIT)
        if fault is not None and fault.kind == "corrupt":
            message = message[:-1] + bytes([message[-1] ^ 0xFF])
        self._send(message)

    def _send(self, message: bytes) -> None:
        try:
            self._socket.sendto(message, self._client)
        except OSError as error:
            _LOG.debug("FRI: %s", error)

    def _end(self) -> None:
        """Say that the session has ended."""
        if not self.dead:
            self._counter += 1
            self._send(self._message(_IDLE))
        self.dead = True

    def close(self) -> None:
        """End the session."""
        self._end()
        self._socket.close()

    @property
    def quality(self) -> int:
        """0 (poor) to 3 (excellent), by the part of the last messages that was answered."""
        share = sum(self._answered) / _JUDGED
        return sum(share >= least for least in (0.5, 0.8, 0.95))

    def _take(self) -> None:
        while True:
            try:
                datagram, sender = self._socket.recvfrom(2048)
            except OSError:  # nothing is there, or the last message found nobody
                return
            if sender == self._client:
                self._judge(datagram)

    def _judge(self, datagram: bytes) -> None:
        """A reply has a header with three numbers; anything else in it is a command, which ends the session."""
        if self._version == "2.7":
            message = datagram[4:-4]
            if struct.unpack("<I", datagram[:4])[0] != len(message) or struct.unpack("<I", datagram[-4:])[
                0
            ] != zlib.crc32(message):
                _LOG.warning("FRI: a reply whose length or checksum is wrong")
                return
        else:
            message = datagram
        if len(message) < 2 or message[0] != 0x0A or message[1] != len(message) - 2:
            _LOG.error("FRI: a command was sent to an arm that is only monitored; the session ends")
            self.dead = True
            return
        numbers = _numbers(message[2:])
        if len(numbers) == 3 and numbers[0] == _COMMAND_ID:
            self._reflected = numbers[1]
            self._replied_to.add(numbers[2])

    def _message(self, state: int) -> bytes:
        controller = self._controller
        q = [float(v) for v in controller.q]
        stopped = 0 if controller.safety == "normal" else 2
        robot = _int(1, 7) + _int(2, stopped) + 7 * _int(5, 2) + _int(6, _MODES[controller.mode]) + _int(7, 0)
        seconds, nanoseconds = divmod(time.time_ns(), 10**9)
        joints = b"".join(b"\x09" + struct.pack("<d", v) for v in q)
        torques = b"".join(b"\x09" + struct.pack("<d", 0.0) for _ in q)
        monitor = _part(1, joints) + _part(2, torques)
        if self._version == "1":
            monitor += _part(3, joints)
        monitor += _part(5, torques) + _part(15, _int(1, seconds) + _int(2, nanoseconds))
        message = (
            _part(1, _int(1, _MONITOR_ID) + _int(2, self._counter) + _int(3, self._reflected))
            + _part(2, robot)
            + _part(3, monitor)
            + _part(4, _int(1, state) + _int(2, self.quality) + _int(3, self._period_ms) + _int(4, 1))
        )
        if self._version == "2.7":
            return struct.pack("<I", len(message)) + message + struct.pack("<I", zlib.crc32(message))
        return message + _part(15, _int(1, len(message)))


def _int(tag: int, value: int) -> bytes:
    return _varint(tag << 3) + _varint(value)


def _part(tag: int, content: bytes) -> bytes:
    return _varint(tag << 3 | 2) + _varint(len(content)) + content


def _varint(value: int) -> bytes:
    out = b""
    while value >= 128:
        out += bytes([value % 128 + 128])
        value //= 128
    return out + bytes([value])


def _numbers(content: bytes) -> list[int]:
    """The values of consecutive fields that are numbers."""
    values: list[int] = []
    value = shift = 0
    key = True
    for byte in content:
        value += (byte & 127) << shift
        shift += 7
        if byte < 128:
            if not key:
                values.append(value)
            key, value, shift = not key, 0, 0
    return values
