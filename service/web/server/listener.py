"""The listening socket: the limits see every connection as it is accepted, before TLS and before a byte is read."""

from __future__ import annotations

import errno
import resource
import socket
from collections.abc import Callable
from contextlib import suppress
from typing import Any
from weakref import finalize

from service.core.units import ms
from service.web.server.connections import Connections

_BACKLOG = 128  # connections that wait in the kernel
ACCEPTED_AT_ONCE = 8  # before the event loop reads what the last ones have sent: their requests may be there already
_EXHAUSTED = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)


class Listener(socket.socket):
    """Listens for asyncio's servers, which call `accept` until it would block."""

    def __init__(self, family: socket.AddressFamily, connections: Connections) -> None:
        super().__init__(family, socket.SOCK_STREAM)
        self.connections = connections
        self._exhausted = False

    def listen(self, backlog: int = _BACKLOG, /) -> None:
        """Listen with a queue of at least _BACKLOG; asyncio's smaller number is how many it accepts at once."""
        super().listen(max(backlog, _BACKLOG))

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept the next connection. Raises BlockingIOError if there is none, or no room for it, and OSError."""
        if self._exhausted:
            # After a system error, asyncio calls accept again, backlog times in all, and logs each error before it
            # pauses for a second. BlockingIOError ends that loop after the first error.
            self._exhausted = False
            raise BlockingIOError
        try:
            plain, address = super().accept()
        except OSError as error:
            if error.errno in _EXHAUSTED:
                self._exhausted = True
                self.connections.make_room()
            raise
        accepted = _AcceptedSocket(plain, self.connections.limits.wait_s)
        connection = self.connections.admit(accepted, (address[0], address[1]))
        if connection is None:
            accepted.close()
            raise BlockingIOError  # the event loop calls again at once if other connections are waiting
        accepted.at_close(lambda: self.connections.leave(connection))
        return accepted, address


class _AcceptedSocket(socket.socket):
    """An accepted socket that tells when it is closed."""

    def __init__(self, plain: socket.socket, wait_s: float) -> None:
        super().__init__(plain.family, plain.type, plain.proto, fileno=plain.detach())
        self._closed_hook: Callable[[], object] = _nothing
        if hasattr(socket, "TCP_USER_TIMEOUT"):
            # A tablet out of reach acknowledges nothing: it is given up, and its streams with it.
            with suppress(OSError):  # it may have been reset in the queue
                self.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(ms(wait_s)))

    def at_close(self, hook: Callable[[], object]) -> None:
        """Call this once, when the socket is closed or was forgotten."""
        self._closed_hook = finalize(self, hook)

    def close(self) -> None:
        """Close the socket and call the hook of `at_close`."""
        super().close()
        self._closed_hook()


def _nothing() -> None:
    """Stand in until somebody asks to be told that a connection was closed."""


def affordable_connections(wanted: int) -> int:
    """The wanted number of connections, at most half of the files that this process may open."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return wanted if soft == resource.RLIM_INFINITY else max(1, min(wanted, soft // 2))
