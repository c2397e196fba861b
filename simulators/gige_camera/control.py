"""GigE Vision's control protocol (GVCP) on UDP: discovery, registers, memory, resends; one client controls."""

from __future__ import annotations

import logging
import socket
import struct
import threading
import time
from collections.abc import Callable

from simulators.gige_camera.registers import (
    ACCESS_DENIED,
    CONTROL,
    DISCOVERY_BYTES,
    HEARTBEAT_MS,
    INVALID_PARAMETER,
    RefusedError,
    Registers,
)
from simulators.serve import SimulatorError
from simulators.units import ms

PORT = 3956
_KEY, _WANTS_ANSWER = 0x42, 0x01
_NOT_IMPLEMENTED = 0x8001
_LONGEST = 536  # bytes of data in a message
_LOG = logging.getLogger(__name__)

Peer = tuple[str, int]


class ControlServer:
    """Answers clients; a context manager. `written` is called after a register was written, with its address."""

    def __init__(
        self,
        host: str,
        registers: Registers,
        written: Callable[[int], None],
        resend: Callable[[int, int, int], None],
    ) -> None:
        self._registers, self._written, self._resend = registers, written, resend
        self._controller: Peer | None = None
        self._heard_s = 0.0  # of the controller
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host, PORT))
        except OSError as error:
            raise SimulatorError(f"cannot listen on {host}:{PORT}: {error.strerror}") from error
        self._thread = threading.Thread(target=self._serve, name="control", daemon=True)

    def __enter__(self) -> ControlServer:
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._socket.close()

    def _serve(self) -> None:
        while True:
            try:
                message, peer = self._socket.recvfrom(2048)
                answer = self._answer(message, peer)
                if answer:
                    self._socket.sendto(answer, peer)
            except OSError:
                return  # it was closed

    def _answer(self, message: bytes, peer: Peer) -> bytes:
        if len(message) < 8:
            return b""
        key, flags, command, length, number = struct.unpack(">BBHHH", message[:8])
        data = message[8 : 8 + length]
        if key != _KEY or len(data) != length:
            return b""
        if peer == self._controller:
            self._heard_s = time.monotonic()
        status, reply = 0, b""
        try:
            reply = self._carry_out(command, data, peer)
        except RefusedError as refusal:
            status = refusal.status
        except struct.error:
            status = INVALID_PARAMETER
        if not flags & _WANTS_ANSWER:
            return b""
        return struct.pack(">HHHH", status, command + 1, len(reply), number) + reply

    def _carry_out(self, command: int, data: bytes, peer: Peer) -> bytes:
        match command:
            case 0x02:  # discovery
                return self._registers.read(0, DISCOVERY_BYTES)
            case 0x40:  # resend
                _, block, first, last = struct.unpack(">HHII", data[:12])
                self._resend(block, first & 0xFFFFFF, last & 0xFFFFFF)
                return b""
            case 0x80:  # read registers
                addresses = struct.unpack(f">{len(data) // 4}I", data)
                return b"".join(self._registers.read(address, 4) for address in addresses)
            case 0x82:  # write registers
                pairs = struct.unpack(f">{len(data) // 4}I", data)
                for address, value in zip(pairs[::2], pairs[1::2], strict=True):
                    self._write(address, value.to_bytes(4, "big"), peer)
                return struct.pack(">HH", 0, len(pairs) // 2)
            case 0x84:  # read memory
                address, _, count = struct.unpack(">IHH", data)
                if count > _LONGEST:
                    raise RefusedError(INVALID_PARAMETER)
                return data[:4] + self._registers.read(address, count)
            case 0x86:  # write memory
                self._write(int.from_bytes(data[:4], "big"), data[4:], peer)
                return struct.pack(">HH", 0, len(data) - 4)
            case _:
                raise RefusedError(_NOT_IMPLEMENTED)

    def _write(self, address: int, data: bytes, peer: Peer) -> None:
        """Write for a client that has control, or that may take it."""
        if peer != self._controller:
            if address != CONTROL or self._is_controlled():
                raise RefusedError(ACCESS_DENIED)
            self._controller, self._heard_s = peer, time.monotonic()
        self._registers.write(address, data)
        if address == CONTROL and not int.from_bytes(data, "big"):
            self._controller = None
        self._written(address)

    def _is_controlled(self) -> bool:
        """Return whether a client has control and was heard within the time of its heartbeat."""
        silent_s = time.monotonic() - self._heard_s
        return self._controller is not None and ms(silent_s) < self._registers.get(HEARTBEAT_MS)
