"""GigE Vision between a driver and a camera: names of its datagrams; addresses are translated by the way."""

from __future__ import annotations

import socket
import struct
from collections.abc import Callable, Coroutine
from typing import Any, Protocol

from tests.support.torture.faults.wire.streams import Datagrams, Link, Peer

_WRITE_REGISTERS, _WRITE_MEMORY = 0x82, 0x86
_ANSWERS = {0x81: "register", 0x83: "written", 0x85: "description", 0x87: "set"}
_PARTS = {1: "leader", 2: "trailer", 3: "payload"}
_STREAM_PORT, _STREAM_ADDRESS = 0xD00, 0xD18  # registers that say where images go
_KEY = 0x42  # the first byte of a request


class Hand(Protocol):
    """Hands a message over to be spoilt or passed on."""

    def __call__(
        self, link: Link, kind: str, message: bytes, target: Datagrams, *, answers: bool
    ) -> Coroutine[Any, Any, None]:
        """Return the work, to be begun."""
        ...


class GigeVision:
    """The control protocol (GVCP) at `near`, and the images (GVSP), as if the camera at `far` were there.

    Every socket of the driver has one of its own towards the camera, which distinguishes its clients by their ports.
    """

    def __init__(
        self, near: Peer, far: Peer, begin: Callable[[Coroutine[Any, Any, None]], object], hand: Hand
    ) -> None:
        self._near, self._far, self._begin, self._hand = near, far, begin, hand
        self._control = Datagrams()
        self._clients: dict[Peer, tuple[Link, Datagrams]] = {}
        self._images = Datagrams()  # where the camera sends them
        self._image_port = 0
        self._driver: tuple[str, int] = ("", 0)  # where the driver awaits them
        self._link = Link(lambda: None)

    async def open(self) -> None:
        """Listen. Raises OSError."""
        await self._control.open(self._near, lambda data: self._begin(self._request(data, self._control.peer)))
        await self._images.open((self._near[0], 0), lambda data: self._begin(self._image(data)))
        self._image_port = self._images.port

    def close(self) -> None:
        """Close all sockets."""
        for port in (self._control, self._images, *(far for _, far in self._clients.values())):
            port.close()
        self._clients.clear()

    async def _request(self, data: bytes, peer: Peer | None) -> None:
        assert peer is not None  # a request has come from there
        if peer not in self._clients:
            far = Datagrams()
            far.peer = self._far
            self._clients[peer] = Link(far.close), far
            await far.open((self._near[0], 0), lambda data: self._begin(self._answer(data, peer)))
        link, far = self._clients[peer]
        data = self._translated(data)
        await self._hand(link, "request", data, far, answers=False)

    async def _answer(self, data: bytes, peer: Peer) -> None:
        kind = _ANSWERS.get(int.from_bytes(data[2:4], "big"), "")
        data = data.replace(socket.inet_aton(self._far[0]), socket.inet_aton(self._near[0]))
        await self._hand(self._clients[peer][0], kind, data, self._control.towards(peer), answers=True)

    async def _image(self, data: bytes) -> None:
        if self._driver[1] and len(data) > 4:
            kind = _PARTS.get(data[4] & 0x7F, "")
            await self._hand(self._link, kind, data, self._images.towards(self._driver), answers=True)

    def _translated(self, request: bytes) -> bytes:
        """A request in which images are to be sent here; where the driver wanted them is kept."""
        command = int.from_bytes(request[2:4], "big")
        one = command == _WRITE_MEMORY and len(request) == 16  # four bytes of memory: a register
        if request[:1] != bytes([_KEY]) or not (one or command == _WRITE_REGISTERS):
            return request
        pairs = list(struct.iter_unpack(">II", request[8 : 8 + (len(request) - 8) // 8 * 8]))
        host, port = self._driver
        for number, (address, value) in enumerate(pairs):
            if address == _STREAM_ADDRESS and value:
                host = socket.inet_ntoa(value.to_bytes(4, "big"))
                pairs[number] = address, int.from_bytes(socket.inet_aton(self._near[0]), "big")
            if address == _STREAM_PORT:
                port = value & 0xFFFF
                pairs[number] = address, value - port + (self._image_port if port else 0)
        if (host, port) != self._driver:
            self._driver, self._link = (host, port), Link(lambda: None)  # another stream
        return request[:8] + b"".join(struct.pack(">II", *pair) for pair in pairs)
