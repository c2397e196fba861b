"""Around every response: which hosts and origins are answered, how large a request may be, and safety headers."""

from __future__ import annotations

import re
import threading
from collections import OrderedDict, deque
from collections.abc import Iterable
from ipaddress import ip_address
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.people.person import TooManyTriesError
from service.store.durable_effects import Clock

BODY_LIMIT_BYTES = 1_000_000
PHOTOGRAPH_LIMIT_BYTES = 16_200_000  # of a note with its photograph; read only for people who are signed in
_WITH_PHOTOGRAPH = re.compile(r"/runs/[^/]{1,64}/notes")
TRIES_WINDOW_S = 300.0  # over which failed tries of an address are counted
CONTENT_SECURITY_POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' data: blob:",
        "connect-src 'self'",
        "frame-src 'self'",
        "form-action 'self'",
        "base-uri 'none'",
        "frame-ancestors 'self'",
    )
)
SAFETY_HEADERS = {
    "Content-Security-Policy": CONTENT_SECURITY_POLICY,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "SAMEORIGIN",
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=(), usb=(), serial=(), payment=()",
}
_SAFE_METHODS = ("GET", "HEAD", "OPTIONS")


def add_safety_headers(headers: MutableHeaders, path: str) -> None:
    """Add what a response has not set itself, such as the policy of a sandboxed frame."""
    for name, value in SAFETY_HEADERS.items():
        headers.setdefault(name, value)
    headers.setdefault("Cache-Control", "no-cache" if path.startswith("/static/") else "no-store")


class Shield:
    """Outermost of the application's own middleware, in plain ASGI so that streams pass through it unbuffered."""

    def __init__(self, app: ASGIApp, hosts: tuple[str, ...]) -> None:
        self._app = app
        self._hosts = frozenset(_host_name(host) for host in hosts)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                add_safety_headers(MutableHeaders(scope=message), scope["path"])
            await send(message)

        limit = PHOTOGRAPH_LIMIT_BYTES if _WITH_PHOTOGRAPH.fullmatch(scope["path"]) else BODY_LIMIT_BYTES
        refusal = self._refusal(scope["method"], headers, limit)
        if refusal is not None:
            await _plain(send_with_headers, *refusal)
            return
        received = 0

        async def receive_limited() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > limit:
                raise HTTPException(413, "the request is too large")
            return message

        await self._app(scope, receive_limited, send_with_headers)

    def _refusal(self, method: str, headers: Headers, limit: int) -> tuple[int, str] | None:
        host = headers.get("host", "")
        if not self._answers_to(_host_name(host)):
            # Against DNS rebinding: a page under a foreign name that points here could act as this site's own.
            return 421, "This site does not answer to that name. Use the address that `orthocapture serve` printed."
        size = headers.get("content-length", "0")
        if not size.isdecimal() or int(size) > limit:
            return 413, "The request is too large; nothing was done."
        if method not in _SAFE_METHODS and not _is_from_own_page(headers, host):
            return 403, "The request came from another site; nothing was done."
        return None

    def _answers_to(self, name: str) -> bool:
        if name in self._hosts:
            return True
        try:
            ip_address(name)  # a plain IP address is not a DNS name
        except ValueError:
            return False
        return True


def _host_name(host: str) -> str:
    try:
        return (urlsplit(f"//{host}").hostname or "").lower()
    except ValueError:
        return ""


def _is_from_own_page(headers: Headers, host: str) -> bool:
    # Programs send neither header; a browser sends at least one with every POST, and pages cannot forge them.
    if headers.get("sec-fetch-site", "same-origin") not in ("same-origin", "none"):
        return False
    origin = headers.get("origin")
    if origin is None:
        return True
    try:
        return urlsplit(origin).netloc.lower() == host.lower()
    except ValueError:
        return False


async def _plain(send: Send, status: int, text: str) -> None:
    body = text.encode()
    content = [(b"content-type", b"text/plain; charset=utf-8"), (b"content-length", str(len(body)).encode())]
    await send({"type": "http.response.start", "status": status, "headers": content})
    await send({"type": "http.response.body", "body": body})


class Limiter:
    """Counts failed tries of each client address over the last minutes, in memory."""

    def __init__(
        self,
        clock: Clock,
        failed_tries: Iterable[tuple[str, float]] = (),
        *,
        tries: int = 20,
        window_s: float = TRIES_WINDOW_S,
        addresses: int = 10_000,
    ) -> None:
        """`failed_tries`: address and age in s of failed tries before the service started, oldest first."""
        self._clock = clock
        self._tries = tries
        self._window_s = window_s
        self._addresses = addresses
        self._failed: OrderedDict[str, deque[float]] = OrderedDict()
        self._lock = threading.Lock()
        for address, age_s in failed_tries:
            self._count(address, clock.monotonic_s() - age_s)

    def require(self, address: str) -> None:
        """Raises TooManyTriesError while an address has failed too often."""
        now = self._clock.monotonic_s()
        with self._lock:
            failed = self._failed.get(address, deque())
            while failed and now - failed[0] >= self._window_s:
                failed.popleft()
            if len(failed) < self._tries:
                return
            wait_s = failed[0] + self._window_s - now
        error = TooManyTriesError(
            "too many failed tries from this address", where=address, remedy=f"Wait {wait_s:.0f} s, then try again"
        )
        error.wait_s = wait_s
        raise error

    def failed(self, address: str) -> bool:
        """Count a failed try. Returns whether the address has now failed too often."""
        with self._lock:
            return self._count(address, self._clock.monotonic_s())

    def _count(self, address: str, at_s: float) -> bool:
        failed = self._failed.setdefault(address, deque(maxlen=self._tries))
        failed.append(at_s)
        self._failed.move_to_end(address)
        while len(self._failed) > self._addresses:
            self._failed.popitem(last=False)
        return len(failed) == self._tries
