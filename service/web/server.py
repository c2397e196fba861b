"""The HTTP server: uvicorn behind the limits on connections, with a log that no client can make grow."""

from __future__ import annotations

import asyncio
import logging
import signal
import socket
import sys
import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from typing import TextIO

import uvicorn
from fastapi import FastAPI
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.core.errors import ConfigurationError
from service.logs import EscapingFormatter
from service.store.durable_effects import Clock
from service.web.connections import (
    ACCEPTED_AT_ONCE,
    Connection,
    ConnectionLimits,
    Connections,
    Listener,
    plain_address,
)


class Reception:
    """Outermost, in plain ASGI. The application finds the request's `Connection` in its state."""

    def __init__(self, app: ASGIApp, connections: Connections) -> None:
        self._app = app
        self._connections = connections

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        client: tuple[str, int] | None = scope.get("client")
        connection = self._connections.find((client[0], client[1])) if client else None
        if scope["type"] != "http" or connection is None:
            await self._app(scope, receive, send)
            return
        scope.setdefault("state", {})["connection"] = connection
        with self._connections.answered(connection):
            await self._app(scope, self._arriving(receive), self._leaving(send, connection))

    def _arriving(self, receive: Receive) -> Receive:
        deadline_s = asyncio.get_running_loop().time() + self._connections.limits.wait_s
        whole = False

        async def receive_in_time() -> Message:
            nonlocal whole
            if whole:
                return await receive()
            try:
                async with asyncio.timeout_at(deadline_s):
                    message = await receive()
            except TimeoutError:
                if whole:  # another reader has it; this one waits for the client to go
                    return await receive()
                raise HTTPException(408, "the request did not arrive", headers={"Connection": "close"}) from None
            whole = not message.get("more_body", False)
            return message

        return receive_in_time

    def _leaving(self, send: Send, connection: Connection) -> Send:
        async def send_in_time(message: Message) -> None:
            try:
                async with asyncio.timeout(self._connections.limits.wait_s):
                    await send(message)
            except TimeoutError:
                self._connections.drop(connection)

        return send_in_time


class ForwardedClient:
    """The client's address and scheme as a proxy forwards them, believed from known proxies alone."""

    def __init__(self, app: ASGIApp, proxies: frozenset[str]) -> None:
        """Believe the `proxies` only, addresses as `plain_address` writes them."""
        self._app = app
        self._proxies = proxies

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        client: tuple[str, int] | None = scope.get("client")
        if scope["type"] == "http" and client:
            address, port = plain_address(client[0]), client[1]
            if address in self._proxies:
                headers = Headers(scope=scope)
                scheme = headers.getlist("x-forwarded-proto")[-1:]
                if scheme in (["http"], ["https"]):
                    scope["scheme"] = scheme[0]
                address, port = self._last_stranger(address, headers.getlist("x-forwarded-for")), 0
            scope["client"] = (address, port)
        await self._app(scope, receive, send)

    def _last_stranger(self, proxy: str, forwarded: list[str]) -> str:
        """Read from the right, each entry was written by the one after it: the first that is not our proxy counts."""
        believed = proxy
        for entry in reversed(",".join(forwarded).split(",")):
            address = _address(entry.strip())
            if not address:
                break
            believed = address
            if address not in self._proxies:
                break
        return believed


def _address(entry: str) -> str:
    """Return the address of an entry, which may have a port; "" for anything else."""
    if entry.startswith("["):
        entry = entry[1:].partition("]")[0]
    elif entry.count(":") == 1:
        entry = entry.partition(":")[0]
    try:
        return plain_address(str(ip_address(entry)))
    except ValueError:
        return ""


EVERY_S = 60.0
_KINDS = 200  # all further ones count as one
_LEFT_OUT = "left_out"  # in a record, for handlers that come after
_FAULTS = 10  # of the software per period: people are given a reference, which must be found

Kind = tuple[str | int, ...]


@dataclass(slots=True)
class _Repeats:
    """The messages of one kind since `since_s`."""

    since_s: float
    name: str
    words: str
    written: int = 0
    left_out: int = 0


class SparingHandler(logging.StreamHandler[TextIO]):
    """Writes messages of one kind at most once a minute. A kind is a line of code and an error's place."""

    def __init__(self, stream: TextIO, clock: Clock, *, every_s: float = EVERY_S) -> None:
        super().__init__(stream)
        words = EscapingFormatter("%(asctime)s %(name)s %(levelname)s %(message)s", "%Y-%m-%dT%H:%M:%SZ")
        words.converter = time.gmtime
        self.setFormatter(words)
        self._clock = clock
        self._every_s = every_s
        self._told: dict[Kind, _Repeats] = {}

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record, or count it if one of its kind was just written; logging.Handler holds its lock."""
        now_s = self._clock.monotonic_s()
        self._tell(now_s)
        kind = _kind(record)
        if kind not in self._told and len(self._told) >= _KINDS:
            kind = ("others",)
        told = self._told.setdefault(kind, _Repeats(now_s, record.name, record.getMessage().partition("\n")[0][:200]))
        if told.written < (_FAULTS if record.exc_info and record.name.startswith("orthocapture") else 1):
            told.written += 1
            super().emit(record)
        else:
            told.left_out += 1
            vars(record)[_LEFT_OUT] = True

    async def tell(self) -> None:
        """Say how many were left out in times that are over; to be called now and then."""
        self.acquire()
        try:
            self._tell(self._clock.monotonic_s())
        finally:
            self.release()

    def close(self) -> None:
        """Say how many messages were left out in all."""
        self._tell(float("inf"))
        super().close()

    def _tell(self, now_s: float) -> None:
        over = [kind for kind, told in self._told.items() if now_s - told.since_s >= self._every_s]
        for told in map(self._told.pop, over):
            if told.left_out:
                words = f"{told.left_out} more messages like this were left out: {told.words}"
                super().emit(logging.makeLogRecord({"name": told.name, "levelname": "WARNING", "msg": words}))


def told(record: logging.LogRecord) -> bool:
    """Return whether the sparing handler, which comes first, wrote this message rather than leave it out."""
    return not vars(record).get(_LEFT_OUT)


def _kind(record: logging.LogRecord) -> Kind:
    place = (record.name, record.pathname, record.lineno)
    _, error, traceback = record.exc_info or (None, None, None)
    while traceback is not None and traceback.tb_next is not None:
        traceback = traceback.tb_next
    if error is None or traceback is None:
        return place
    return (*place, type(error).__name__, traceback.tb_frame.f_code.co_filename, traceback.tb_lineno)


@contextmanager
def sparing_log(clock: Clock) -> Generator[SparingHandler]:
    """Send all messages of this process through one such handler to stderr, and through no other."""
    handler = SparingHandler(sys.stderr, clock)
    root = logging.getLogger()
    usual = root.handlers[:]
    for each in usual:
        root.removeHandler(each)
    root.addHandler(handler)
    try:
        yield handler
    finally:
        root.removeHandler(handler)
        for each in usual:
            root.addHandler(each)
        handler.close()


def known_proxies(addresses: Sequence[str]) -> frozenset[str]:
    """Return the addresses of trusted proxies in their usual form.

    Raises ConfigurationError for what is not an address.
    """
    for address in addresses:
        try:
            ip_address(address)
        except ValueError:
            raise ConfigurationError(
                f"{address!r} is not an address",
                where="--trusted-proxy",
                remedy="Give the IP address from which the proxy connects, such as 10.0.0.5",
            ) from None
    return frozenset(map(plain_address, addresses))


@contextmanager
def listening(host: str, port: int, limits: ConnectionLimits, proxies: frozenset[str]) -> Generator[Listener]:
    """Yield the socket, bound before anything is recorded: a second server on the port changes nothing."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with Listener(family, Connections(limits, without_limit=proxies)) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((host, port))
        except OSError as error:
            raise ConfigurationError(
                f"cannot listen on {host}:{port}: {error.strerror or error}",
                where="--host, --port",
                remedy="Another program may use the port; choose one with --port, or 0 for any",
            ) from error
        listener.listen()
        yield listener


def server(
    app: FastAPI, listener: Listener, proxies: frozenset[str], tls: tuple[Path, Path] | None, log: SparingHandler
) -> Server:
    """Return the server of an application on a socket."""
    config = uvicorn.Config(
        Reception(ForwardedClient(app, proxies), listener.connections),
        loop="asyncio",  # its servers accept through the listener
        ws="none",
        backlog=ACCEPTED_AT_ONCE,
        proxy_headers=False,  # it believes everybody on this machine; see Forwarded
        log_config=None,
        log_level="warning",
        access_log=False,
        server_header=False,
        callback_notify=log.tell,
        timeout_notify=round(EVERY_S),
        timeout_graceful_shutdown=2,  # streams of news never end by themselves
        ssl_certfile=tls and str(tls[0]),
        ssl_keyfile=tls and str(tls[1]),
    )
    return Server(config)


class Server(uvicorn.Server):
    """A server that ends in order; uvicorn's own would raise the signal again, past what is left to do here."""

    @contextmanager
    def capture_signals(self) -> Generator[None]:
        """Let Ctrl-C and SIGTERM end the server."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self.handle_exit)
        yield
