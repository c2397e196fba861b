"""Badges: supervisors and administrators give and take them, their owners agree by password and may report a loss."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Form, Path, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response

from service.core.errors import OrthocaptureError
from service.people.person import AccountError, SignInRefusedError
from service.web.page.errors import status_of, wants_json
from service.web.page.rendering import render
from service.web.run.forms import Reason
from service.web.security.guards import SignedInPerson, requires
from service.web.site import CurrentSite, Site

router = APIRouter(tags=["people"])

AccountName = Annotated[str, Path(max_length=40)]
Secret = Annotated[str, Form(max_length=256)]
_ENROL = [Depends(requires("enrol"))]


@router.get("/badges", name="badges", dependencies=_ENROL, response_class=HTMLResponse)
def badges(request: Request, site: CurrentSite) -> HTMLResponse:
    """Who has a badge."""
    return _page(request, site)


@router.post("/badges/{account}", name="enrol_badge", dependencies=_ENROL, response_class=RedirectResponse)
def enrol(
    request: Request, site: CurrentSite, person: SignedInPerson, account: AccountName, password: Secret, badge: Secret
) -> Response:
    """Give an account a badge. Its owner must be present, to type the account's password."""
    try:
        site.people.badges.enrol(person, account, password, badge)
    except (AccountError, SignInRefusedError) as error:
        return _refused(request, site, account, error)
    return RedirectResponse("/badges", status_code=303)


@router.post("/badges/{account}/revoke", name="revoke_badge", dependencies=_ENROL, response_class=RedirectResponse)
def revoke(
    request: Request, site: CurrentSite, person: SignedInPerson, account: AccountName, reason: Reason
) -> Response:
    """Take a badge away."""
    try:
        site.people.badges.revoke(person, account, reason)
    except AccountError as error:
        return _refused(request, site, account, error)
    return RedirectResponse("/badges", status_code=303)


@router.post(
    "/account/badge/revoke",
    name="report_badge_lost",
    dependencies=[Depends(requires("read"))],
    response_class=RedirectResponse,
)
def report_lost(site: CurrentSite, person: SignedInPerson) -> Response:
    """Report one's own badge lost; it can no longer sign."""
    site.people.badges.revoke(person, person.account, "reported lost by its owner")
    return RedirectResponse("/account?done=badge", status_code=303)


def _refused(request: Request, site: Site, account: str, error: OrthocaptureError) -> Response:
    if wants_json(request):
        raise error
    return _page(request, site, account=account, problem=error)


def _page(
    request: Request, site: Site, *, account: str = "", problem: OrthocaptureError | None = None
) -> HTMLResponse:
    return render(
        request,
        "people/badges.html.j2",
        status=status_of(problem) if problem else 200,
        accounts=[one for one in site.people.accounts.all() if one.state == "active" or one.badge],
        allowed=site.rig.section.signing.badge,
        tried=account,
        problem=problem,
    )
