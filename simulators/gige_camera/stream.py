"""GigE Vision's stream protocol (GVSP) on UDP: an image as leader, payload and trailer; packets sent again."""

from __future__ import annotations

import socket
import struct
import threading
import time

from simulators.gige_camera.registers import (
    HEIGHT,
    PACKET_BYTES,
    PACKET_DELAY,
    STREAM_ADDRESS,
    STREAM_PORT,
    STREAM_SOURCE,
    TICKS_PER_S,
    WIDTH,
    Registers,
)

_IMAGE = 0x0001
_LEADER, _TRAILER, _PAYLOAD = 1, 2, 3
_UNAVAILABLE = 0x800C
_HEADERS = 20 + 8 + 8  # bytes of IP, UDP and GVSP, which the packet size includes
_AT_ONCE = 16  # packets between two pauses, since no computer pauses for microseconds


class Stream:
    """Sends images to where the registers say."""

    def __init__(self, host: str, registers: Registers) -> None:
        self._registers = registers
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((host, 0))
        registers.set(STREAM_SOURCE, self._socket.getsockname()[1])
        self._lock = threading.Lock()
        self._block = 0
        self._packets: list[bytes] = []  # of the last image
        self._sent = 0  # of these
        self._to = ("", 0)
        self._lost_for_good: frozenset[int] = frozenset()

    def send(
        self, block: int, code: int, pixels: bytes, exposed_ns: int, lost: int = 0, lost_share: float = 0.0, *,
        for_good: bool = False, stall_s: float = 0.0,
    ) -> None:  # fmt: skip
        """Send an image with this pixel format.

        `lost` packets in its middle are lost, perhaps for good, or the last ones, trailer included, as a share of all
        (so a receiver loses them whose socket is full); `stall_s` is a pause in its middle.
        """
        packets = self._packed(block, code, pixels, exposed_ns)
        middle = len(packets) // 2
        first_lost, last_lost = middle, middle + lost
        if lost_share:
            first_lost, last_lost = round(len(packets) * (1.0 - lost_share)), len(packets)
        missing = frozenset(range(first_lost, last_lost))
        with self._lock:
            self._block, self._packets, self._sent = block, packets, 0
            address = socket.inet_ntoa(self._registers.read(STREAM_ADDRESS, 4))
            self._to = address, self._registers.get(STREAM_PORT) & 0xFFFF
            self._lost_for_good = missing if for_good else frozenset()
        pause_s = self._registers.get(PACKET_DELAY) / TICKS_PER_S * _AT_ONCE
        for number, packet in enumerate(packets):
            with self._lock:
                if number not in missing:
                    self._put(packet)
                self._sent = number + 1
            if number % _AT_ONCE == 0:
                time.sleep(pause_s)
            if number == middle:
                time.sleep(stall_s)

    def resend(self, block: int, first: int, last: int) -> None:
        """Send packets of the last image again; what is lost for good is said to be unavailable.

        Packets that were not sent yet, and those of other images, are not sent.
        """
        with self._lock:
            for number in range(first, min(last + 1, self._sent) if block == self._block else first):
                lost = number in self._lost_for_good
                self._put(_header(block, _PAYLOAD, number, _UNAVAILABLE) if lost else self._packets[number])

    def _packed(self, block: int, code: int, pixels: bytes, exposed_ns: int) -> list[bytes]:
        size = (self._registers.get(WIDTH), self._registers.get(HEIGHT))
        room = (self._registers.get(PACKET_BYTES) & 0xFFFF) - _HEADERS
        leader = struct.pack(">HHQIIIIIHH", 0, _IMAGE, exposed_ns, code, *size, 0, 0, 0, 0)
        packets = [_header(block, _LEADER, 0) + leader]
        for number, first in enumerate(range(0, len(pixels), room), start=1):
            packets.append(_header(block, _PAYLOAD, number) + pixels[first : first + room])
        packets.append(_header(block, _TRAILER, len(packets)) + struct.pack(">HHI", 0, _IMAGE, size[1]))
        return packets

    def _put(self, packet: bytes) -> None:
        if self._to[1]:
            self._socket.sendto(packet, self._to)


def _header(block: int, kind: int, number: int, status: int = 0) -> bytes:
    return struct.pack(">HHI", status, block, kind << 24 | number)
