"""Runs before the application: limits how long requests may take to arrive and answers to be read, per client."""

from __future__ import annotations

import asyncio
from ipaddress import ip_address

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.web.server.connections import Connection, Connections, plain_address


class Reception:
    """Outermost, in plain ASGI. The application finds the request's `Connection` in its state."""

    def __init__(self, app: ASGIApp, connections: Connections) -> None:
        self._app = app
        self._connections = connections

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request."""
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
        """`proxies`: addresses as `plain_address` writes them."""
        self._app = app
        self._proxies = proxies

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request."""
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
    """The address of an entry, which may have a port; "" for anything else."""
    if entry.startswith("["):
        entry = entry[1:].partition("]")[0]
    elif entry.count(":") == 1:
        entry = entry.partition(":")[0]
    try:
        return plain_address(str(ip_address(entry)))
    except ValueError:
        return ""
