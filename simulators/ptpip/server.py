"""The sockets of a simulated camera: one command and one event connection, for one client at a time."""

from __future__ import annotations

import logging
import socket
import struct
import threading
import time
from contextlib import suppress

from simulators.faults import Fault, FaultPlan
from simulators.ptpip import codec
from simulators.ptpip.codec import PacketType
from simulators.ptpip.reply import Reply, Responder
from simulators.serve import listening

_GUID = bytes.fromhex("53494d554c415445444f52544f434150")
_STALL_S = 5.0
_LOG = logging.getLogger(__name__)


class LinkClosedError(Exception):
    """The client disconnected, or a planned fault cut the connection."""


def _receive(link: socket.socket, count: int) -> bytes:
    parts = bytearray()
    while len(parts) < count:
        # Linux resets TCP_QUICKACK after each use; without it, the client's Nagle algorithm costs 40 ms per set.
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)
        part = link.recv(min(count - len(parts), 1 << 20))
        if not part:
            raise LinkClosedError("the client closed the connection")
        parts += part
    return bytes(parts)


def _receive_packet(link: socket.socket) -> tuple[PacketType, bytes]:
    kind, length = codec.parse_header(_receive(link, codec.HEADER_BYTES))
    return kind, _receive(link, length)


class _Session:
    """A command connection and the event connection that joined it."""

    def __init__(self, number: int, command: socket.socket) -> None:
        self.number = number
        self.command = command
        self.event: socket.socket | None = None
        self._lock = threading.Lock()

    def send_event(self, code: int, parameters: tuple[int, ...]) -> None:
        with self._lock, suppress(OSError):
            if self.event is not None:
                self.event.sendall(codec.event(code, 0xFFFFFFFF, parameters))

    def close(self) -> None:
        with self._lock:
            for link in (self.command, self.event):
                if link is not None:
                    with suppress(OSError):
                        link.shutdown(socket.SHUT_RDWR)
                    link.close()

    def reset(self) -> None:
        """Close the connection with RST instead of FIN."""
        for link in (self.command, self.event):
            if link is not None:
                link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        with suppress(OSError):
            self.command.close()


class PtpIpServer:
    """Listens, pairs the connections and serves operations of a camera of this name. A context manager."""

    def __init__(self, host: str, port: int, name: str, responder: Responder, faults: FaultPlan) -> None:
        self._name = name
        self._faults = faults
        self._responder = responder
        self._session: _Session | None = None
        self._next_number = 1
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._listener = listening(host, port)
        self.address: tuple[str, int] = self._listener.getsockname()[:2]
        self._acceptor = threading.Thread(target=self._accept, name="ptpip-accept", daemon=True)

    def __enter__(self) -> PtpIpServer:
        self._acceptor.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._stopping.set()
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        with self._lock:
            session, self._session = self._session, None
        if session is not None:
            session.close()
        self._acceptor.join(2.0)

    def send_event(self, code: int, parameters: tuple[int, ...]) -> None:
        """Send an event to the client, if there is one."""
        session = self._session
        if session is not None:
            session.send_event(code, parameters)

    def _accept(self) -> None:
        while not self._stopping.is_set():
            try:
                link, peer = self._listener.accept()
            except OSError:
                return
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            threading.Thread(target=self._welcome, args=(link, peer), name=f"ptpip-{peer[1]}", daemon=True).start()

    def _welcome(self, link: socket.socket, peer: object) -> None:
        try:
            kind, body = _receive_packet(link)
            if kind is PacketType.INIT_COMMAND_REQUEST:
                self._serve_commands(link, codec.parse_init_command(body))
            elif kind is PacketType.INIT_EVENT_REQUEST:
                self._join(link, codec.parse_init_event(body))
            else:
                link.sendall(codec.packet(PacketType.INIT_FAIL, struct.pack("<I", 3)))
                link.close()
        except (LinkClosedError, codec.CodecError, OSError) as error:
            _LOG.info("connection of %s ended: %s", peer, error)
            link.close()

    def _join(self, link: socket.socket, number: int) -> None:
        session = self._session
        if session is None or session.number != number:
            link.sendall(codec.packet(PacketType.INIT_FAIL, struct.pack("<I", 1)))
            link.close()
            return
        session.event = link
        link.sendall(codec.packet(PacketType.INIT_EVENT_ACK))
        # Probe requests may arrive on this socket; nothing else is expected from the client.
        while True:
            kind, _ = _receive_packet(link)
            if kind is PacketType.PROBE_REQUEST:
                link.sendall(codec.packet(PacketType.PROBE_RESPONSE))

    def _serve_commands(self, link: socket.socket, hello: codec.InitCommand) -> None:
        fault = self._faults.check("camera", "init")
        if fault is not None and fault.kind == "reject":
            link.sendall(codec.packet(PacketType.INIT_FAIL, struct.pack("<I", 2)))
            link.close()
            return
        with self._lock:
            # A client that reconnects after a crash replaces its dead predecessor.
            previous, session = self._session, _Session(self._next_number, link)
            self._session, self._next_number = session, self._next_number + 1
        if previous is not None:
            previous.close()
        _LOG.info("session %d with %s", session.number, hello.name)
        try:
            link.sendall(codec.init_command_ack(session.number, _GUID, self._name))
            while not self._stopping.is_set():
                self._transaction(session)
        finally:
            with self._lock:
                if self._session is session:
                    self._session = None
            session.close()

    def _transaction(self, session: _Session) -> None:
        link = session.command
        kind, body = _receive_packet(link)
        if kind is PacketType.PROBE_REQUEST:
            link.sendall(codec.packet(PacketType.PROBE_RESPONSE))
            return
        if kind is not PacketType.OPERATION_REQUEST:
            raise codec.CodecError(f"{kind.name} where an operation should be")
        request = codec.parse_request(body)
        data = self._client_data(link) if request.sends_data else b""
        reply = self._responder.handle(request, data)
        self._answer(session, request, reply)

    def _client_data(self, link: socket.socket) -> bytes:
        kind, body = _receive_packet(link)
        if kind is not PacketType.START_DATA:
            raise codec.CodecError(f"{kind.name} where data should start")
        announced, data = codec.parse_start_data(body), bytearray()
        if announced == 0:
            return b""  # libgphoto2 sends no End_Data after announcing zero bytes
        while True:
            kind, body = _receive_packet(link)
            if kind not in (PacketType.DATA, PacketType.END_DATA):
                raise codec.CodecError(f"{kind.name} within data")
            data += body[4:]
            if len(data) > announced:
                raise codec.CodecError(f"{len(data)} bytes where {announced} were announced")
            if kind is PacketType.END_DATA:
                return bytes(data)

    def _answer(self, session: _Session, request: codec.Request, reply: Reply) -> None:
        link, fault = session.command, reply.wire_fault
        if reply.data is None:
            self._cut(session, fault)
        else:
            data = reply.data
            if fault is not None and fault.kind == "truncate":
                data = data[: len(data) * 6 // 10]
            packets = list(codec.data_packets(request.transaction, data, chunk_bytes=256 * 1024))
            if fault is not None and fault.kind in ("drop", "reset", "stall"):
                half = b"".join(packets)[: len(data) // 2]
                link.sendall(half)
                self._cut(session, fault)
                link.sendall(b"".join(packets)[len(half) :])
            else:
                for one in packets:
                    link.sendall(one)
        link.sendall(codec.response(reply.code, request.transaction, reply.parameters))

    def _cut(self, session: _Session, fault: Fault | None) -> None:
        if fault is None:
            return
        if fault.kind == "stall":
            time.sleep(float(fault.value or _STALL_S))
        elif fault.kind in ("drop", "reset"):
            if fault.kind == "reset":
                session.reset()
            raise LinkClosedError(f"planned fault: {fault.kind}")
