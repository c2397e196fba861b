"""The HTTP server: uvicorn behind the limits on connections, with a log that no client can make grow."""

from __future__ import annotations

import signal
import socket
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from ipaddress import ip_address
from pathlib import Path

import uvicorn
from fastapi import FastAPI

from service.core.errors import ConfigurationError
from service.web.server.connections import ConnectionLimits, Connections, plain_address
from service.web.server.listener import ACCEPTED_AT_ONCE, Listener
from service.web.server.reception import ForwardedClient, Reception
from service.web.server.sparing_log import EVERY_S, SparingHandler


def known_proxies(addresses: Sequence[str]) -> frozenset[str]:
    """The addresses of trusted proxies in their usual form. Raises ConfigurationError for what is not an address."""
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
    """The socket, bound before anything is recorded: a second server on the port changes nothing."""
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
    """The server of an application on a socket."""
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
    """Ends in order when told to; uvicorn's own would raise the signal again, past what is left to do here."""

    @contextmanager
    def capture_signals(self) -> Generator[None]:
        """Ctrl-C and SIGTERM end the server."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self.handle_exit)
        yield
