"""The simulated industrial camera's memory: the bootstrap registers of GigE Vision, its own, and its description."""

from __future__ import annotations

import socket
import struct
import threading
from importlib.resources import files

VENDOR, MODEL, VERSION, SERIAL = "Orthocapture", "GE-1", "1.0", "22334455"

# Bootstrap registers.
_GIGE_VISION_1_2 = 0x00010002
_BIG_ENDIAN_UTF8 = 0x80000001
_MAC = 0x0200_5E00_0001  # locally administered
DISCOVERY_BYTES = 0xF8
_CURRENT_ADDRESS, _NETMASK = 0x24, 0x34
_DESCRIPTION_URL = 0x200
_STREAMS = 0x904
_CAPABILITY, _MEMORY_WRITES, _RESENDS = 0x934, 1 << 1, 1 << 2
HEARTBEAT_MS = 0x938
_TICKS_HZ = 0x93C
CONTROL = 0xA00
STREAM_PORT, PACKET_BYTES, PACKET_DELAY, STREAM_ADDRESS, STREAM_SOURCE = 0xD00, 0xD04, 0xD08, 0xD18, 0xD1C
TICKS_PER_S = 1_000_000_000

# Its own registers, as camera.xml says.
WIDTH, HEIGHT, PIXEL_FORMAT, PAYLOAD_BYTES, ACQUISITION_MODE = 0x10000, 0x10004, 0x10008, 0x1000C, 0x10010
START, STOP, EXPOSURE_US, GAIN_DB = 0x10014, 0x10018, 0x10020, 0x10028
_DESCRIPTION = 0x20000
SINGLE_FRAME = 1
MONO8, BAYER_RG8, RGB8 = 0x01080001, 0x01080009, 0x02180014
_BYTES = {MONO8: 1, BAYER_RG8: 1, RGB8: 3}  # of a pixel
_EXPOSURES_US, _GAINS_DB = (20.0, 2e6), (0.0, 24.0)
_WRITABLE = [
    (HEARTBEAT_MS, 4), (CONTROL, 4), (STREAM_PORT, 12), (STREAM_ADDRESS, 4), (PIXEL_FORMAT, 4),
    (ACQUISITION_MODE, 12), (EXPOSURE_US, 16),
]  # fmt: skip


class RefusedError(Exception):
    """An access is refused; `status` is GigE Vision's code."""

    def __init__(self, status: int) -> None:
        super().__init__(f"{status:#06x}")
        self.status = status


INVALID_PARAMETER, INVALID_ADDRESS, WRITE_PROTECT, BAD_ALIGNMENT, ACCESS_DENIED = range(0x8002, 0x8007)


class Registers:
    """The memory, big-endian; thread-safe."""

    def __init__(self, host: str, width: int, height: int) -> None:
        description = files("simulators.gige_camera").joinpath("camera.xml").read_bytes()
        padded = description + bytes(-len(description) % 4)
        self._memory = bytearray(_DESCRIPTION) + padded
        self._lock = threading.Lock()
        for address, text in ((0x48, VENDOR), (0x68, MODEL), (0x88, VERSION), (0xD8, SERIAL)):
            self._put(address, text.encode())
        self._put(_DESCRIPTION_URL, f"Local:camera.xml;{_DESCRIPTION:x};{len(description):x}".encode())
        self._put(_CURRENT_ADDRESS, socket.inet_aton(host))
        self._put(8, struct.pack(">Q", _MAC))
        self._put(_TICKS_HZ, struct.pack(">Q", TICKS_PER_S))
        for address, value in {
            0: _GIGE_VISION_1_2, 4: _BIG_ENDIAN_UTF8, _NETMASK: 0xFF000000, 0x600: 1, _STREAMS: 1,
            _CAPABILITY: _MEMORY_WRITES | _RESENDS, HEARTBEAT_MS: 3000, PACKET_BYTES: 1500, PACKET_DELAY: 10_000,
            WIDTH: width, HEIGHT: height, PIXEL_FORMAT: BAYER_RG8,
        }.items():  # fmt: skip
            self.set(address, value)
        self._put(EXPOSURE_US, struct.pack(">dd", 10_000.0, 0.0))
        self._measure()

    def get(self, address: int) -> int:
        """A register of four bytes."""
        return int.from_bytes(self.read(address, 4), "big")

    def set(self, address: int, value: int) -> None:
        """Set a register of four bytes, as the camera itself does."""
        self._put(address, value.to_bytes(4, "big"))

    def real(self, address: int) -> float:
        """A register of eight bytes with a floating-point number."""
        return float(struct.unpack(">d", self.read(address, 8))[0])

    def read(self, address: int, count: int) -> bytes:
        """Read memory. Raises RefusedError."""
        if address % 4 or count % 4:
            raise RefusedError(BAD_ALIGNMENT)
        if address + count > len(self._memory):
            raise RefusedError(INVALID_ADDRESS)
        with self._lock:
            return bytes(self._memory[address : address + count])

    def write(self, address: int, data: bytes) -> None:
        """Write memory, as a client does. Raises RefusedError."""
        if address % 4 or len(data) % 4:
            raise RefusedError(BAD_ALIGNMENT)
        if not any(first <= address and address + len(data) <= first + length for first, length in _WRITABLE):
            raise RefusedError(WRITE_PROTECT)
        if address == PIXEL_FORMAT and int.from_bytes(data, "big") not in _BYTES:
            raise RefusedError(INVALID_PARAMETER)
        self._put(address, data)
        self._measure()

    def _put(self, address: int, data: bytes) -> None:
        with self._lock:
            self._memory[address : address + len(data)] = data

    def _measure(self) -> None:
        """Keep the size of an image, and exposure time and gain within the sensor's steps and limits."""
        size = self.get(WIDTH) * self.get(HEIGHT) * _BYTES[self.get(PIXEL_FORMAT)]
        self.set(PAYLOAD_BYTES, size)
        for address, step, (lowest, highest) in ((EXPOSURE_US, 1.0, _EXPOSURES_US), (GAIN_DB, 0.1, _GAINS_DB)):
            value = round(self.real(address) / step) * step
            self._put(address, struct.pack(">d", min(highest, max(lowest, value))))
