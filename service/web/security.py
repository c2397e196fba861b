"""Guards around every request: hosts, size and headers, sign-in and permission of routes, the sealed chain."""

from __future__ import annotations

import logging
import re
import threading
from collections import OrderedDict, deque
from collections.abc import AsyncGenerator, Iterable
from hmac import compare_digest
from ipaddress import ip_address
from typing import Annotated
from urllib.parse import urlsplit

from fastapi import Depends, Request, Response
from fastapi.concurrency import run_in_threadpool
from starlette.datastructures import FormData, Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.core.errors import OrthocaptureError
from service.people.control import Control
from service.people.person import (
    NotAllowedError,
    NotSignedInError,
    Permission,
    Person,
    ScreenLockedError,
    TooManyTriesError,
)
from service.store.durable_effects import Clock
from service.store.records import SITE, UnknownRunError
from service.store.signatures.signing import checkpoint_here
from service.web.connections import Connection
from service.web.site import CurrentSite, Site

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
        """Serve one request, or refuse it by its host, size or headers."""
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
        """Start with the `failed_tries` from before the service started: address and age in s, oldest first."""
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


_log = logging.getLogger("orthocapture.web")


async def sealed(request: Request, site: CurrentSite) -> AsyncGenerator[None]:
    """Sign before the answer is sent, also for refused requests; a dependency of all routes (`scope="function"`).

    Only requests such as POST need it: accounts, invitations, sign-ins and signatures, refused ones included.
    """
    try:
        yield
    finally:
        if request.method not in _SAFE_METHODS:
            await run_in_threadpool(seal, site)


def seal(site: Site) -> None:
    """Sign the unsigned end of the site's chain. A failure is logged; what was done stays done."""
    try:
        seq = site.store.head(SITE)
        if seq != site.sealed_seq:
            checkpoint_here(site.store, SITE)
            site.sealed_seq = seq
            site.second_place.update()
    except UnknownRunError:
        return  # nothing has happened here yet
    except OrthocaptureError as error:
        _log.error("the site's record could not be signed: %s", error)


SAFE_METHODS = frozenset({"GET", "HEAD"})
THEFT_REMEDY = "Load the page again and repeat; nothing was done"


# --- cookies -------------------------------------------------------------------------------------------------


def cookie_name(site: Site) -> str:
    """Return the cookie's name; browsers accept the prefix from a secure origin only, for exactly this host."""
    return "__Host-orthocapture" if site.secure else "orthocapture"


def set_cookie(response: Response, site: Site, token: str) -> None:
    """Hand a sign-in's token to the browser, until it is closed."""
    response.set_cookie(cookie_name(site), token, path="/", secure=site.secure, httponly=True, samesite="strict")


def clear_cookie(response: Response, site: Site) -> None:
    """Remove the token from the browser."""
    response.delete_cookie(cookie_name(site), path="/", secure=site.secure, httponly=True, samesite="strict")


def token_of(request: Request, site: Site) -> str:
    """Return the token that came with a request; "" for none."""
    return request.cookies.get(cookie_name(site), "")


# --- guards --------------------------------------------------------------------------------------------------


class Guard:
    """Lets a request pass when its person may; a route has exactly one."""

    def __init__(self, permission: Permission, while_locked: bool | tuple[str, ...]) -> None:
        self.permission: Permission = permission
        self._while_locked = while_locked

    async def __call__(self, request: Request, site: CurrentSite) -> None:
        """Raises NotSignedInError, NotAllowedError, ScreenLockedError; else `request.state.person` is set."""
        person = await run_in_threadpool(
            site.people.person,
            token_of(request, site),
            idle_lock_s=site.idle_lock_s,
            deliberate=_is_deliberate(request),
        )
        if person is None:
            raise NotSignedInError("nobody is signed in on this screen", remedy="Sign in")
        request.state.person = person
        _keep_connection(request)
        form = FormData()
        if request.method not in SAFE_METHODS:
            form = await request.form()
            _require_own_form(request, form, person)
        if not person.may(self.permission):
            raise NotAllowedError(
                f"the role {person.role} may not do this ({self.permission})",
                where=request.url.path,
                remedy="Ask somebody whose role allows this",
            )
        if person.locked and not self._passes_lock(request, form):
            raise ScreenLockedError(
                "this screen is locked", where=f"screen {person.screen}", remedy="Enter the PIN to continue"
            )

    def _passes_lock(self, request: Request, form: FormData) -> bool:
        if request.method in SAFE_METHODS and self.permission == "read":
            return True
        if isinstance(self._while_locked, bool):
            return self._while_locked
        return form.get("verb") in self._while_locked


def requires(permission: Permission, *, while_locked: bool | tuple[str, ...] = False) -> Guard:
    """Return the guard of a route: `dependencies=[Depends(requires("read"))]`.

    Args:
        permission: a permission of service.people.person.
        while_locked: true if a locked screen may do it too; or the values of the form field `verb` that it may do.
    """
    return Guard(permission, while_locked)


def _signed(request: Request) -> Person:
    person = getattr(request.state, "person", None)
    if not isinstance(person, Person):
        raise NotSignedInError("nobody is signed in on this screen", remedy="Sign in")
    return person


SignedInPerson = Annotated[Person, Depends(_signed)]


def controls(run_id: str, person: SignedInPerson, site: CurrentSite) -> None:
    """Require that this screen controls the run; a dependency of routes that act on one. Raises ControlError."""
    Control(site.store).require(run_id, person)


def _require_own_form(request: Request, form: FormData, person: Person) -> None:
    given = request.headers.get("x-csrf-token") or form.get("csrf")
    if not isinstance(given, str) or not compare_digest(given.encode(), person.csrf.encode()):
        raise NotAllowedError(
            "this form does not belong to the current sign-in", where=request.url.path, remedy=THEFT_REMEDY
        )


def _keep_connection(request: Request) -> None:
    """Protect this connection, now signed in, from being dropped in favour of clients that are not."""
    connection = getattr(request.state, "connection", None)  # none where no `Reception` stands before the application
    if isinstance(connection, Connection):
        connection.known = True


def _is_deliberate(request: Request) -> bool:
    # Requests that the page makes by itself (news, parts, pictures) do not keep a screen from locking.
    if request.method not in SAFE_METHODS:
        return True
    headers = request.headers
    return headers.get("sec-fetch-mode") == "navigate" and headers.get("sec-fetch-dest") == "document"
