"""The administrator's pages: accounts, invitations, roles and badges; changes with a reason, links shown once."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated

from fastapi import APIRouter, Depends, Form, Path, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from markupsafe import Markup

from service.core.errors import OrthocaptureError
from service.people.accounts import INVITATION_S
from service.people.person import ROLES, AccountError, Role, SignInRefusedError
from service.store.durable_effects import utc_text
from service.web.page.rendering import render, status_of, wants_json
from service.web.run.actions import Reason
from service.web.security import SignedInPerson, requires
from service.web.site import CurrentSite, Site

router = APIRouter(tags=["administration"])

Name = Annotated[str, Form(max_length=80)]
AccountName = Annotated[str, Path(max_length=40)]
_ADMINISTER = [Depends(requires("administer"))]


@router.get("/accounts", name="accounts", dependencies=_ADMINISTER, response_class=HTMLResponse)
def accounts(request: Request, site: CurrentSite) -> HTMLResponse:
    """Show all accounts, and the form to invite somebody."""
    return _list(request, site)


@router.post("/accounts", name="invite", dependencies=_ADMINISTER, response_class=HTMLResponse)
def invite(
    request: Request,
    site: CurrentSite,
    person: SignedInPerson,
    account: Name,
    full_name: Name,
    role: Annotated[Role, Form()],
) -> Response:
    """Make an account; the page with its one-time link is shown once."""
    try:
        token = site.people.accounts.invite(person, account, full_name, role)
    except AccountError as error:
        if wants_json(request):
            raise
        return _list(request, site, problem=error, typed={"account": account, "full_name": full_name, "role": role})
    return _link(request, full_name, token)


@router.get("/accounts/{account}", name="account", dependencies=_ADMINISTER, response_class=HTMLResponse)
def account_page(request: Request, site: CurrentSite, account: AccountName) -> HTMLResponse:
    """Show an account and what can be changed about it."""
    return _one(request, site, account)


@router.post(
    "/accounts/{account}/role",
    name="change_role",
    dependencies=_ADMINISTER,
    response_class=RedirectResponse,
    status_code=303,
)
def change_role(
    request: Request,
    site: CurrentSite,
    person: SignedInPerson,
    account: AccountName,
    role: Annotated[Role, Form()],
    reason: Reason,
) -> Response:
    """Give an account another role."""
    try:
        site.people.accounts.change_role(person, account, role, reason)
    except AccountError as error:
        return _refused(request, site, account, error)
    return _back(account)


@router.post(
    "/accounts/{account}/disable",
    name="disable_account",
    dependencies=_ADMINISTER,
    response_class=RedirectResponse,
    status_code=303,
)
def disable(
    request: Request, site: CurrentSite, person: SignedInPerson, account: AccountName, reason: Reason
) -> Response:
    """Disable an account."""
    try:
        site.people.accounts.disable(person, account, reason)
    except AccountError as error:
        return _refused(request, site, account, error)
    return _back(account)


@router.post(
    "/accounts/{account}/enable",
    name="enable_account",
    dependencies=_ADMINISTER,
    response_class=RedirectResponse,
    status_code=303,
)
def enable(
    request: Request, site: CurrentSite, person: SignedInPerson, account: AccountName, reason: Reason
) -> Response:
    """Let a disabled account in again."""
    try:
        site.people.accounts.enable(person, account, reason)
    except AccountError as error:
        return _refused(request, site, account, error)
    return _back(account)


@router.post(
    "/accounts/{account}/end-wait",
    name="end_wait",
    dependencies=_ADMINISTER,
    response_class=RedirectResponse,
    status_code=303,
)
def end_wait(site: CurrentSite, person: SignedInPerson, account: AccountName) -> Response:
    """End an account's wait after wrong passwords."""
    site.people.accounts.end_wait(person.account, account)
    return _back(account)


@router.post("/accounts/{account}/reset", name="reset_account", dependencies=_ADMINISTER, response_class=HTMLResponse)
def reset(
    request: Request, site: CurrentSite, person: SignedInPerson, account: AccountName, reason: Reason
) -> Response:
    """Take away password and PIN; the page with the new one-time link is shown once."""
    try:
        token = site.people.accounts.reset(person, account, reason)
    except AccountError as error:
        return _refused(request, site, account, error)
    return _link(request, account, token)


def utc_of(utc_s: float) -> str:
    """Return the seconds since 1970 as the record writes times."""
    return utc_text(datetime.fromtimestamp(utc_s, UTC))


def _back(account: str) -> RedirectResponse:
    return RedirectResponse(f"/accounts/{account}", status_code=303)


def _link(request: Request, whose: str, token: str) -> HTMLResponse:
    import segno  # noqa: PLC0415 - for this page alone

    address = f"{request.url.scheme}://{request.url.netloc}/set-up/{token}"
    # A picture in the page itself: the link is a secret, and no other address may give it away.
    svg = segno.make_qr(address, error="m").svg_inline(
        omitsize=True, border=4, dark="#000", light="#fff", svgclass="qr"
    )
    return render(
        request,
        "people/account_link.html.j2",
        whose=whose,
        address=address,
        qr=Markup(svg),
        reachable=request.url.hostname not in ("127.0.0.1", "localhost", "::1"),
        hours=round(INVITATION_S / 3600),
    )


def _refused(request: Request, site: Site, account: str, error: AccountError) -> Response:
    if wants_json(request):
        raise error
    return _one(request, site, account, problem=error)


def _list(
    request: Request, site: Site, *, problem: OrthocaptureError | None = None, typed: dict[str, str] | None = None
) -> HTMLResponse:
    accounts = site.people.accounts.all()
    return render(
        request,
        "people/accounts.html.j2",
        status=status_of(problem) if problem else 200,
        accounts=accounts,
        waits={one.account for one in accounts if site.people.accounts.waits_until_utc_s(one)},
        roles=ROLES,
        problem=problem,
        typed=typed or {"account": "", "full_name": "", "role": "technician"},
    )


def _one(request: Request, site: Site, account: str, *, problem: OrthocaptureError | None = None) -> HTMLResponse:
    shown = site.people.accounts.get(account)
    waits_until_utc_s = site.people.accounts.waits_until_utc_s(shown)
    return render(
        request,
        "people/account_administration.html.j2",
        status=status_of(problem) if problem else 200,
        shown=shown,
        waits_until=utc_of(waits_until_utc_s) if waits_until_utc_s else "",
        screens=len(site.people.screens(account)),
        roles=ROLES,
        problem=problem,
    )


Secret = Annotated[str, Form(max_length=256)]
_ENROL = [Depends(requires("enrol"))]


@router.get("/badges", name="badges", dependencies=_ENROL, response_class=HTMLResponse)
def badges(request: Request, site: CurrentSite) -> HTMLResponse:
    """Show who has a badge."""
    return _badges_page(request, site)


@router.post("/badges/{account}", name="enrol_badge", dependencies=_ENROL, response_class=RedirectResponse)
def enrol(
    request: Request, site: CurrentSite, person: SignedInPerson, account: AccountName, password: Secret, badge: Secret
) -> Response:
    """Give an account a badge. Its owner must be present, to type the account's password."""
    try:
        site.people.badges.enrol(person, account, password, badge)
    except (AccountError, SignInRefusedError) as error:
        return _badge_refused(request, site, account, error)
    return RedirectResponse("/badges", status_code=303)


@router.post("/badges/{account}/revoke", name="revoke_badge", dependencies=_ENROL, response_class=RedirectResponse)
def revoke(
    request: Request, site: CurrentSite, person: SignedInPerson, account: AccountName, reason: Reason
) -> Response:
    """Take a badge away."""
    try:
        site.people.badges.revoke(person, account, reason)
    except AccountError as error:
        return _badge_refused(request, site, account, error)
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


def _badge_refused(request: Request, site: Site, account: str, error: OrthocaptureError) -> Response:
    if wants_json(request):
        raise error
    return _badges_page(request, site, account=account, problem=error)


def _badges_page(
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
