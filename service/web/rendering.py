"""Rendering: every page gets who looks, the theme, how the robots stand, its tokens; errors reveal no internals."""

from __future__ import annotations

import logging
import secrets
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from functools import partial
from itertools import takewhile
from typing import TYPE_CHECKING, Any, cast
from urllib.parse import quote

from fastapi import FastAPI, Path, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse, RedirectResponse
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from pydantic import ValidationError
from starlette.exceptions import HTTPException

from service.audit.overview import kind_name
from service.core.errors import ConfigurationError, DataError, IntegrityError, OrthocaptureError, ProtocolError
from service.core.records.entered import RunAbout, about_rows
from service.core.words import counted, local_time
from service.people import person as people
from service.store.records import UnknownRunError
from service.web.robot_banner import LOST
from service.web.run_frame import driven_frames
from service.web.security import add_safety_headers, token_of

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    from service.audit.queries import EventRow

# "run/run.html.j2" is service/web/templates/run/run.html.j2.
TEMPLATES = Environment(
    loader=PackageLoader("service.web"),
    autoescape=select_autoescape(["html", "j2"]),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def kept_in_a_row(rows: Sequence[EventRow], start: int) -> int:
    """Return how many events from `start` on keep files for the same step."""
    first = rows[start]
    return sum(1 for _ in takewhile(lambda row: (row.kind, row.step) == (first.kind, first.step), rows[start:]))


def entered_of(root: EventRow) -> list[tuple[str, str]]:
    """Return what was entered when a run began, from its first event in the database."""
    try:
        return about_rows(RunAbout.model_validate(root.payload.get("about") or {}))
    except ValidationError:  # altered: the verification says so
        return []


# Its type names its own names only.
cast("dict[str, Any]", TEMPLATES.globals).update(kept_in_a_row=kept_in_a_row, about_rows=entered_of, counted=counted)
TEMPLATES.filters["local_time"] = local_time
TEMPLATES.filters["finding_name"] = kind_name


def part_names(*names: str) -> Any:
    """Return the path parameter that names one or more of a page's parts, between commas."""
    one = f"({'|'.join(names)})"
    return Path(pattern=f"^{one}(,{one}){{0,{len(names) - 1}}}$")


def render(
    request: Request, template: str, shown: DataclassInstance | None = None, /, *, status: int = 200, **more: object
) -> HTMLResponse:
    """Render a page, or a part of one.

    Args:
        request: the request; its `person` is who is signed in, or None on the few public pages.
        template: the template's path; `run/run.html.j2` is service/web/templates/run/run.html.j2.
        shown: record of what the page shows; the template has its fields as variables.
        status: the status of the response.
        more: further variables of the template.
    """
    own: Mapping[str, object] = {} if shown is None else {f.name: getattr(shown, f.name) for f in fields(shown)}
    person = getattr(request.state, "person", None)
    text = TEMPLATES.get_template(template).render(
        request=request,
        person=person,
        robots=partial(driven_frames, request.app.state.site),  # asked by whole pages, not by parts
        robots_lost=LOST,
        second_place_away=request.app.state.site.second_place.away,
        **own,
        **more,
    )
    return HTMLResponse(text, status_code=status)


_log = logging.getLogger("orthocapture.web")
SAFE = "What was captured and recorded before is safe; this request changed nothing."
UNSURE = "What was recorded before is safe. Look at the page again to see whether this request had an effect."

# The first class that an error is an instance of; everything else is a conflict with the present state (409).
_STATUS: tuple[tuple[type[OrthocaptureError], int], ...] = (
    (people.NotSignedInError, 401),
    (people.SignInRefusedError, 401),
    (people.PinRefusedError, 403),
    (people.NotAllowedError, 403),
    (people.LinkError, 404),
    (UnknownRunError, 404),
    (people.AccountError, 422),
    (people.ScreenLockedError, 423),
    (people.TooManyTriesError, 429),
    (ConfigurationError, 422),
    (DataError, 422),
    (ProtocolError, 422),
)
_WORDS = {
    400: ("the request cannot be read", "Load the page again and repeat"),
    404: ("there is no such page", "Go to the first page and choose from there"),
    405: ("this address does not do that", "Go to the first page and choose from there"),
    408: ("the request did not arrive in time", "Check the network, then send it again"),
    413: ("the request is too large", "Send less"),
}


@dataclass(frozen=True, slots=True)
class PageProblem:
    """An error in the words of the page and of the JSON body."""

    status: int
    what: str
    where: str
    remedy: str
    safe: str
    reference: str = ""


def status_of(error: OrthocaptureError) -> int:
    """Return the HTTP status that an error means."""
    return next((status for kind, status in _STATUS if isinstance(error, kind)), 409)


def install_errors(app: FastAPI) -> None:
    """Register the handlers."""
    app.add_exception_handler(OrthocaptureError, _expected)
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(HTTPException, _http)
    app.add_exception_handler(Exception, _unexpected)


def wants_json(request: Request) -> bool:
    """Return whether the client reads JSON rather than pages."""
    accepted = request.headers.get("accept", "")
    return "application/json" in accepted and "text/html" not in accepted


def respond(request: Request, problem: PageProblem, headers: dict[str, str] | None = None) -> Response:
    """Return a problem as page or as JSON."""
    if wants_json(request):
        return JSONResponse(asdict(problem), status_code=problem.status, headers=headers)
    _recognise(request)
    response = render(request, "page/error.html.j2", status=problem.status, problem=problem)
    response.headers.update(headers or {})
    return response


def _recognise(request: Request) -> None:
    """Recognise who looks at the page of an error that came before any guard, such as an unknown address."""
    site = request.app.state.site
    if hasattr(request.state, "person"):
        return
    with suppress(OrthocaptureError):  # the page of an error shows what it can
        request.state.person = site.people.person(
            token_of(request, site), idle_lock_s=site.idle_lock_s, deliberate=False
        )


def _expected(request: Request, error: Exception) -> Response:
    if not isinstance(error, OrthocaptureError):
        raise error
    if isinstance(error, people.NotSignedInError) and request.method == "GET" and not wants_json(request):
        return RedirectResponse(f"/sign-in?next={quote(_asked_for(request), safe='/')}", status_code=303)
    safe = (
        "Do not go on before this is understood: evidence does not verify. Nothing was changed."
        if isinstance(error, IntegrityError)
        else SAFE
    )
    problem = PageProblem(status_of(error), error.what, error.where, error.remedy, safe)
    headers = {"Retry-After": f"{error.wait_s:.0f}"} if isinstance(error, people.TooManyTriesError) else None
    return respond(request, problem, headers)


def _asked_for(request: Request) -> str:
    address = f"{request.url.path}?{request.url.query}" if request.url.query else request.url.path
    return address if len(address) <= 400 else "/"


def _invalid(request: Request, error: Exception) -> Response:
    if not isinstance(error, RequestValidationError):
        raise error
    # The rejected values themselves are left out: one of them may be a password.
    details: Sequence[Any] = error.errors()
    places = [".".join(str(part) for part in detail["loc"][1:]) or str(detail["loc"][0]) for detail in details]
    words = [f"{place}: {detail['msg'].lower()}" for place, detail in zip(places, details, strict=True)]
    problem = PageProblem(
        422,
        "the form is not complete or not valid",
        "; ".join(words[:5]),
        "Correct the fields and send it again",
        SAFE,
    )
    return respond(request, problem)


def _http(request: Request, error: Exception) -> Response:
    if not isinstance(error, HTTPException):
        raise error
    what, remedy = _WORDS.get(error.status_code, ("the request was refused", "Load the page again and repeat"))
    problem = PageProblem(error.status_code, what, request.url.path, remedy, SAFE)
    return respond(request, problem, dict(error.headers or {}))


def _unexpected(request: Request, error: Exception) -> Response:
    reference = secrets.token_hex(4)
    _log.error("reference %s: %s %s", reference, request.method, request.url.path, exc_info=error)
    problem = PageProblem(
        500,
        "the software has made a mistake",
        request.url.path,
        f"Tell the administrator the reference {reference}; the log has the details",
        UNSURE,
        reference,
    )
    response = respond(request, problem)
    add_safety_headers(response.headers, request.url.path)  # this one leaves outside of the Shield
    return response
