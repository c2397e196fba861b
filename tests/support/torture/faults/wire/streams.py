"""Terminals and TCP connections as byte streams, UDP ports, and what the proxy knows of each of its links."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import struct
from collections.abc import Callable
from dataclasses import dataclass, field

from tests.support.torture.faults.wire.framing import Talk

Peer = tuple[str, int]


@dataclass(eq=False)
class Link:
    """One connection through the proxy."""

    close: Callable[[], object]
    talk: Talk = field(default_factory=Talk)
    stalled: set[bool] = field(default_factory=set[bool])  # directions in which nothing passes any more
    held: dict[bool, bytes] = field(default_factory=dict[bool, bytes])  # until the next message has passed
    refusing: bool = False


class Pipe:
    """A terminal as a byte stream."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        os.set_blocking(descriptor, False)

    async def read(self) -> bytes:
        """Read the next bytes; empty if the terminal has gone."""
        loop = asyncio.get_running_loop()
        ready = loop.create_future()
        loop.add_reader(self.descriptor, lambda: ready.done() or ready.set_result(None))
        try:
            await ready
            return os.read(self.descriptor, 65536)
        except OSError:
            return b""
        finally:
            with contextlib.suppress(OSError, ValueError):
                loop.remove_reader(self.descriptor)

    async def write(self, data: bytes) -> None:
        """Write the data piecewise, because a serial line is slow."""
        with contextlib.suppress(OSError):
            os.write(self.descriptor, data)


class Stream:
    """A TCP connection as a byte stream."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer = reader, writer

    async def read(self) -> bytes:
        """Read the next bytes; empty at the end."""
        try:
            return await self._reader.read(1 << 16)
        except OSError:
            return b""

    async def write(self, data: bytes) -> None:
        """Write the data. Raises OSError if the peer has gone."""
        self._writer.write(data)
        await self._writer.drain()

    def cut(self) -> None:
        """Close with a reset, like a pulled cable or a device that is switched off."""
        link: socket.socket = self._writer.get_extra_info("socket")
        with contextlib.suppress(OSError):
            link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self._writer.transport.abort()


class Datagrams(asyncio.DatagramProtocol):
    """A UDP port that sends to `peer`: set, or else whoever sent last."""

    def __init__(self) -> None:
        self.peer: Peer | None = None
        self._follows = True
        self._take: Callable[[bytes], object] = lambda _data: None
        self._transport: asyncio.DatagramTransport | None = None

    def towards(self, peer: Peer) -> Datagrams:
        """This port as one that sends to `peer`."""
        same = Datagrams()
        same.peer, same._transport = peer, self._transport
        return same

    @property
    def port(self) -> int:
        """The number of the open port."""
        assert self._transport is not None
        return int(self._transport.get_extra_info("sockname")[1])

    async def open(self, address: Peer, take: Callable[[bytes], object]) -> None:
        """Listen at an address, and hand each datagram to `take`. Raises OSError."""
        self._take, self._follows = take, self.peer is None
        loop = asyncio.get_running_loop()
        self._transport, _ = await loop.create_datagram_endpoint(lambda: self, local_addr=address)

    def datagram_received(self, data: bytes, addr: Peer) -> None:
        """Take a datagram."""
        if self._follows:
            self.peer = addr
        self._take(data)

    async def write(self, data: bytes) -> None:
        """Send a datagram."""
        if self._transport is not None and self.peer is not None:
            self._transport.sendto(data, self.peer)

    def close(self) -> None:
        """Close the port."""
        if self._transport is not None:
            self._transport.abort()
