"""Guards of routes: sign-in, permission, protection against forged requests, and control of the run."""

from __future__ import annotations

from hmac import compare_digest
from typing import Annotated

from fastapi import Depends, Request, Response
from fastapi.concurrency import run_in_threadpool
from starlette.datastructures import FormData

from service.people.control import Control
from service.people.person import NotAllowedError, NotSignedInError, Permission, Person, ScreenLockedError
from service.web.server.connections import Connection
from service.web.site import CurrentSite, Site

SAFE_METHODS = frozenset({"GET", "HEAD"})
THEFT_REMEDY = "Load the page again and repeat; nothing was done"


# --- cookies -------------------------------------------------------------------------------------------------


def cookie_name(site: Site) -> str:
    """Browsers accept the prefix only from a secure origin, for the whole host, and from no other host."""
    return "__Host-orthocapture" if site.secure else "orthocapture"


def set_cookie(response: Response, site: Site, token: str) -> None:
    """Hand a sign-in's token to the browser, until it is closed."""
    response.set_cookie(cookie_name(site), token, path="/", secure=site.secure, httponly=True, samesite="strict")


def clear_cookie(response: Response, site: Site) -> None:
    """Remove the token from the browser."""
    response.delete_cookie(cookie_name(site), path="/", secure=site.secure, httponly=True, samesite="strict")


def token_of(request: Request, site: Site) -> str:
    """The token that came with a request; "" for none."""
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
    """The guard of a route: `dependencies=[Depends(requires("read"))]`.

    Args:
        permission: of service.people.person.
        while_locked: whether a locked screen may do it too; or the values of the form field `verb` that it may do.
    """
    return Guard(permission, while_locked)


def _signed(request: Request) -> Person:
    person = getattr(request.state, "person", None)
    if not isinstance(person, Person):
        raise NotSignedInError("nobody is signed in on this screen", remedy="Sign in")
    return person


SignedInPerson = Annotated[Person, Depends(_signed)]


def controls(run_id: str, person: SignedInPerson, site: CurrentSite) -> None:
    """Dependency of routes that act on a run: this screen must have control of it. Raises ControlError."""
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
