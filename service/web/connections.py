"""Holds the limits on connections: who may have one, for how long, from when it is accepted, and open streams."""

from __future__ import annotations

import asyncio
import errno
import logging
import resource
import socket
import weakref
from collections import Counter
from collections.abc import Callable, Container, Generator, Iterable
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from ipaddress import IPv6Address, ip_address
from typing import Any
from weakref import finalize

from service.core.units import ms

_log = logging.getLogger("orthocapture.connections")

Peer = tuple[str, int]  # address and port, as the kernel writes them


@dataclass(frozen=True, slots=True)
class ConnectionLimits:
    """Limits on the connections of one server."""

    in_all: int = 400
    per_address: int = 64  # a browser opens six
    wait_s: float = 20.0  # for the head of a request, from the connection or the last answer; for its body; for a
    # client to take the next piece of an answer


class Connection:
    """One accepted connection."""

    def __init__(self, accepted: socket.socket, peer: Peer, now_s: float) -> None:
        self.peer = peer
        self.address = plain_address(peer[0])
        self.since_s = now_s
        self.answering = 0  # requests whose head has arrived and whose answer is not complete
        self.known = False  # somebody signed in has asked through it
        self.timer: asyncio.TimerHandle | None = None
        self._accepted = weakref.ref(accepted)  # a socket that its transport forgot is to close itself

    @property
    def rank(self) -> int:
        """The lowest makes room first; 3 never does."""
        return 2 * self.known + (self.answering > 0)

    def stop_waiting(self) -> None:
        """Stop the wait: the request has arrived, or the connection is gone."""
        if self.timer is not None:
            self.timer.cancel()
            self.timer = None

    def shut(self) -> None:
        """End it on the wire; the event loop sees its end and closes the socket."""
        self.stop_waiting()
        accepted = self._accepted()
        if accepted is not None:
            with suppress(OSError):  # the other side may have gone already
                accepted.shutdown(socket.SHUT_RDWR)


class Connections:
    """All connections of a server. Every method is called in the thread of its event loop.

    When there is no room, the one that goes is, in this order: a stranger's that waits for its request, a stranger's
    that is being answered, a signed-in person's that is idle. What answers somebody signed in stays. Within a rank it
    is the oldest of the address that has most.
    """

    def __init__(self, limits: ConnectionLimits, *, without_limit: Container[str] = ()) -> None:
        """Hold none yet; `without_limit`: addresses of many clients, for which only the limit in all counts."""
        self.limits = limits
        self._without_limit = without_limit
        self._open: dict[Peer, Connection] = {}
        self._by_address: Counter[str] = Counter()

    def admit(self, accepted: socket.socket, peer: Peer) -> Connection | None:
        """Take a connection in, for which another may have to go; None when all are at work for signed-in people."""
        loop = asyncio.get_running_loop()
        connection = Connection(accepted, peer, loop.time())
        if peer in self._open:  # its socket was reset and is not yet closed on this side
            self.drop(self._open[peer])
        if not self._has_room(connection.address):
            return None
        self._open[peer] = connection
        self._by_address[connection.address] += 1
        self._await_request(connection)
        return connection

    def find(self, peer: Peer) -> Connection | None:
        """Return the connection that a request came by, while it lasts."""
        return self._open.get(peer)

    def leave(self, connection: Connection) -> None:
        """Forget a connection whose socket is closed."""
        connection.stop_waiting()
        if self._open.get(connection.peer) is connection:
            del self._open[connection.peer]
            self._by_address[connection.address] -= 1
            if not self._by_address[connection.address]:
                del self._by_address[connection.address]

    def drop(self, connection: Connection) -> None:
        """End a connection from this side."""
        connection.shut()
        self.leave(connection)

    def make_room(self) -> bool:
        """Drop the connection that can best be spared; whether there was one."""
        return self._drop_least(self._open.values())

    @contextmanager
    def answered(self, connection: Connection) -> Generator[None]:
        """Suspend the time-out of a connection while its request is being answered."""
        connection.answering += 1
        connection.stop_waiting()
        try:
            yield
        finally:
            connection.answering -= 1
            if not connection.answering and self._open.get(connection.peer) is connection:
                connection.since_s = asyncio.get_running_loop().time()
                self._await_request(connection)

    def _await_request(self, connection: Connection) -> None:
        loop = asyncio.get_running_loop()
        connection.timer = loop.call_later(self.limits.wait_s, self.drop, connection)

    def _has_room(self, address: str) -> bool:
        if address not in self._without_limit and self._by_address[address] >= self.limits.per_address:
            _log.warning("%s has %d connections: its oldest make room", address, self.limits.per_address)
            if not self._drop_least(each for each in self._open.values() if each.address == address):
                return False
        if len(self._open) >= self.limits.in_all:
            _log.warning("there are %d connections: the oldest of strangers make room", self.limits.in_all)
            return self.make_room()
        return True

    def _drop_least(self, among: Iterable[Connection]) -> bool:
        candidates = [connection for connection in among if connection.rank < 3]
        if not candidates:
            return False
        self.drop(min(candidates, key=lambda each: (each.rank, -self._by_address[each.address], each.since_s)))
        return True


def plain_address(text: str) -> str:
    """Return an address in its usual form, so that one client has one name: ::ffff:10.0.0.7 is 10.0.0.7."""
    try:
        address = ip_address(text)
    except ValueError:
        return text
    mapped = address.ipv4_mapped if isinstance(address, IPv6Address) else None
    return str(mapped or address)


@dataclass(eq=False, slots=True)
class OpenStream:
    """The event stream of one page."""

    screen: str
    replaced: bool = False  # it is to say so and to end


class OpenStreams:
    """All streams of a server, oldest first. Used in the thread of its event loop alone.

    A page that was loaded again, or a tablet that dropped out, leaves a stream behind for a while. Were the new one
    refused, the person would be without news: so it replaces the oldest of its sign-in, or of the one that has most.
    """

    def __init__(self, *, per_screen: int = 6, in_all: int = 60) -> None:
        self._per_screen = per_screen
        self._in_all = in_all
        self._open: list[OpenStream] = []

    @contextmanager
    def opened(self, screen: str) -> Generator[OpenStream]:
        """Yield a place among the streams of a sign-in, for as long as it lasts."""
        count = Counter(stream.screen for stream in self._open)
        if count[screen] >= self._per_screen:
            self._end_oldest(screen)
        elif len(self._open) >= self._in_all:
            self._end_oldest(max(count, key=lambda each: count[each]))
        stream = OpenStream(screen)
        self._open.append(stream)
        try:
            yield stream
        finally:
            if stream in self._open:
                self._open.remove(stream)

    def _end_oldest(self, screen: str) -> None:
        oldest = next(stream for stream in self._open if stream.screen == screen)
        oldest.replaced = True
        self._open.remove(oldest)


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
    """An accepted socket that reports when it is closed."""

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
    """Stand in until somebody asks for a call when a connection is closed."""


def affordable_connections(wanted: int) -> int:
    """Return the wanted number of connections, at most half of the files that this process may open."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return wanted if soft == resource.RLIM_INFINITY else max(1, min(wanted, soft // 2))
