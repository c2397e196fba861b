"""A TCP connection of a simulator that never waits for its peer: what is not read at once is sent later."""

from __future__ import annotations

import socket

_CHUNK_BYTES = 65536


def accept(listener: socket.socket) -> socket.socket:
    """Accept the next connection; it does not block, and small messages are sent at once."""
    accepted, _ = listener.accept()
    accepted.setblocking(False)
    accepted.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return accepted


class Connection:
    """A connection with its unsent bytes; `dead` when the peer has gone or is to be dropped."""

    def __init__(self, accepted: socket.socket) -> None:
        self.socket = accepted
        self.out = bytearray()
        self.dead = False

    def send(self, data: bytes) -> None:
        """Send now, or later when the peer reads again."""
        self.out += data
        self.flush()

    def flush(self) -> None:
        """Send the queued bytes, as far as the peer reads."""
        try:
            while self.out:
                del self.out[: self.socket.send(self.out)]
        except BlockingIOError:
            return
        except OSError:
            self.dead = True

    def read(self) -> bytes:
        """Return what has arrived; b"" if nothing has, or if the peer has gone."""
        try:
            data = self.socket.recv(_CHUNK_BYTES)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        self.dead = self.dead or not data
        return data
