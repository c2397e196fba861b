"""Terminals and TCP connections as byte streams for the proxy."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import struct


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
