"""Who may hold a connection and for how long: limits in all and by address, by which strangers make room."""

from __future__ import annotations

import asyncio
import logging
import socket
import weakref
from collections import Counter
from collections.abc import Container, Generator, Iterable
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from ipaddress import IPv6Address, ip_address

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
        """The request has arrived, or the connection is gone."""
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
        """`without_limit`: addresses that stand for many clients; only the limit in all counts for them."""
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
        """The connection that a request came by, while it lasts."""
        return self._open.get(peer)

    def leave(self, connection: Connection) -> None:
        """Its socket is closed."""
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
    """An address in its usual form, so that one client has one name: ::ffff:10.0.0.7 is 10.0.0.7."""
    try:
        address = ip_address(text)
    except ValueError:
        return text
    mapped = address.ipv4_mapped if isinstance(address, IPv6Address) else None
    return str(mapped or address)
