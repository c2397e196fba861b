"""Signing in and out, links, the screen's lock, a person's own account, and the administrator's pages."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from typing import Annotated, cast

from fastapi import APIRouter, Depends, Form, Path, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from markupsafe import Markup
from pydantic import BaseModel, Field

from service.core.errors import OrthocaptureError
from service.people.accounts import INVITATION_S
from service.people.credentials import on_screen_of
from service.people.person import ROLES, AccountError, AccountJustChangedError, Role, SignInRefusedError
from service.store.durable_effects import utc_text
from service.web.rendering import render, status_of, wants_json
from service.web.run_actions import Reason
from service.web.security import Limiter, SignedInPerson, clear_cookie, requires, set_cookie, token_of
from service.web.site import CurrentSite, Site

# --- the administrator's pages: accounts, invitations, roles and badges -------------------------------------------

router = APIRouter(tags=["people"])

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
    return _after(request, site, account, partial(site.people.accounts.change_role, person, account, role, reason))


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
    return _after(request, site, account, partial(site.people.accounts.disable, person, account, reason))


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
    return _after(request, site, account, partial(site.people.accounts.enable, person, account, reason))


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


def _after(request: Request, site: Site, account: str, change: Callable[[], object]) -> Response:
    """Make a change, and go back to the account; say there why it was refused."""
    try:
        change()
    except AccountError as error:
        return _refused(request, site, account, error)
    return _back(account)


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


Pin = Annotated[str, Form(max_length=12)]
Back = Annotated[str, Form(max_length=500)]
Token = Annotated[str, Path(max_length=100)]


def own_page(address: str) -> str:
    """Return an address of this site to go to, or the first page when it is anything else."""
    plain = address.isascii() and address.isprintable() and "\\" not in address
    return address if plain and address.startswith("/") and not address.startswith("//") else "/"


def _go(address: str) -> RedirectResponse:
    return RedirectResponse(address, status_code=303)


def _limiter(request: Request) -> Limiter:
    return cast(Limiter, request.app.state.limiter)


def _address(request: Request) -> str:
    return request.client.host if request.client else ""


# --- signing in and out --------------------------------------------------------------------------------------


@router.get("/sign-in", name="sign_in_page", response_class=HTMLResponse)
def sign_in_page(
    request: Request,
    site: CurrentSite,
    next_page: Annotated[str, Query(alias="next", max_length=500)] = "/",
    done: Annotated[str, Query(max_length=20)] = "",
) -> HTMLResponse:
    """Show the form to sign in with."""
    return render(
        request,
        "people/sign_in.html.j2",
        next_page=own_page(next_page),
        nobody=not site.people.accounts.all(),
        done=done,
        account="",
        problem=None,
    )


@router.post("/sign-in", name="sign_in", response_class=RedirectResponse, status_code=303)
def sign_in(
    request: Request,
    site: CurrentSite,
    account: Name,
    password: Secret,
    next_page: Annotated[str, Form(alias="next", max_length=500)] = "/",
) -> Response:
    """Sign in. The browser always gets a new token."""
    limiter, address = _limiter(request), _address(request)
    if not site.people.may_try(account, address):
        limiter.require(address)
    try:
        token = site.people.sign_in(account, password, address=address, replaces=token_of(request, site))
    except SignInRefusedError as error:
        # What is counted is what is recorded, so that a restart counts the same.
        if not isinstance(error, AccountJustChangedError) and limiter.failed(address):
            site.people.refuse_address(address)
        if wants_json(request):
            raise
        return render(
            request,
            "people/sign_in.html.j2",
            status=401,
            next_page=own_page(next_page),
            nobody=False,
            done="",
            account=account,
            problem=error,
        )
    response = _go(own_page(next_page))
    set_cookie(response, site, token)
    return response


@router.post(
    "/sign-out",
    name="sign_out",
    dependencies=[Depends(requires("read", while_locked=True))],
    response_class=RedirectResponse,
    status_code=303,
)
def sign_out(site: CurrentSite, person: SignedInPerson) -> Response:
    """End this sign-in."""
    site.people.sign_out(person)
    response = _go("/sign-in?done=signed-out")
    clear_cookie(response, site)
    return response


# --- one-time links ------------------------------------------------------------------------------------------


@router.get("/set-up/{token}", name="set_up_page", response_class=HTMLResponse)
def set_up_page(request: Request, site: CurrentSite, token: Token) -> HTMLResponse:
    """Show the form behind a one-time link. Looking at it does not use it up."""
    return _set_up_form(request, site, token, None)


class SetUpForm(BaseModel):
    """The choices of a person behind a one-time link; only the first administrator also chooses the two names."""

    password: str = Field(max_length=256)
    repeated: str = Field(max_length=256)
    pin: str = Field(max_length=12)
    account: str = Field("", max_length=80)
    full_name: str = Field("", max_length=80)


@router.post("/set-up/{token}", name="set_up", response_class=RedirectResponse, status_code=303)
def set_up(
    request: Request,
    site: CurrentSite,
    token: Token,
    form: Annotated[SetUpForm, Form()],
) -> Response:
    """Use a link: the first administrator chooses a name, everybody a password and a PIN."""
    invitation = site.people.accounts.invitation(token)
    try:
        _require_same(form.password, form.repeated)
        if invitation.account:
            site.people.accounts.accept(token, form.password, form.pin)
        else:
            site.people.accounts.set_up(token, form.account, form.full_name, form.password, form.pin)
    except AccountError as error:
        if wants_json(request):
            raise
        return _set_up_form(request, site, token, error, form.account, form.full_name)
    return _go("/sign-in?done=set-up")


def _set_up_form(
    request: Request,
    site: CurrentSite,
    token: str,
    problem: AccountError | None,
    account: str = "",
    full_name: str = "",
) -> HTMLResponse:
    invitation = site.people.accounts.invitation(token)
    return render(
        request,
        "people/set_up.html.j2",
        status=422 if problem else 200,
        invitation=invitation,
        token=token,
        account=account,
        full_name=full_name,
        problem=problem,
    )


def _require_same(password: str, repeated: str) -> None:
    if password != repeated:
        raise AccountError("the two passwords differ", where="repeated", remedy="Type the same one twice")


# --- the screen's lock ---------------------------------------------------------------------------------------


@router.post(
    "/lock",
    name="lock",
    dependencies=[Depends(requires("read", while_locked=True))],
    response_class=RedirectResponse,
    status_code=303,
)
def lock(site: CurrentSite, person: SignedInPerson, back: Back = "/") -> Response:
    """Lock this screen: it goes on showing, and acts no more until the PIN is given."""
    site.people.lock(person)
    return _go(own_page(back))


@router.get("/unlock", name="unlock_page", dependencies=[Depends(requires("read"))], response_class=HTMLResponse)
def unlock_page(request: Request, back: Annotated[str, Query(max_length=500)] = "/") -> HTMLResponse:
    """Show the form for the PIN, for browsers without script; pages show it over themselves."""
    return render(request, "people/unlock.html.j2", back=own_page(back), problem=None)


@router.post(
    "/unlock",
    name="unlock",
    dependencies=[Depends(requires("read", while_locked=True))],
    response_class=RedirectResponse,
    status_code=303,
)
def unlock(request: Request, site: CurrentSite, person: SignedInPerson, pin: Pin, back: Back = "/") -> Response:
    """Open this screen with the PIN."""
    try:
        site.people.unlock(person, pin)
    except OrthocaptureError as error:
        if wants_json(request) or status_of(error) == 401:
            raise
        return render(request, "people/unlock.html.j2", status=status_of(error), back=own_page(back), problem=error)
    return _go(own_page(back))


# --- one's own account ---------------------------------------------------------------------------------------


@router.get("/account", name="own_account", dependencies=[Depends(requires("read"))], response_class=HTMLResponse)
def own_account(
    request: Request, site: CurrentSite, person: SignedInPerson, done: Annotated[str, Query(max_length=20)] = ""
) -> HTMLResponse:
    """Show password, PIN and screens of the person who looks."""
    return _own_account(request, site, person, done=done)


@router.post(
    "/account/password",
    name="change_password",
    dependencies=[Depends(requires("read"))],
    response_class=RedirectResponse,
    status_code=303,
)
def change_password(
    request: Request,
    site: CurrentSite,
    person: SignedInPerson,
    password: Secret,
    new_password: Secret,
    repeated: Secret,
) -> Response:
    """Set a new password; the person's other screens are signed out."""
    try:
        _require_same(new_password, repeated)
        site.people.check_password(person.account, password, on_screen_of(person))
        site.people.accounts.change_password(person, new_password)
    except (AccountError, SignInRefusedError) as error:
        if wants_json(request):
            raise
        return _own_account(request, site, person, problem=error, form="password")
    return _go("/account?done=password")


@router.post(
    "/account/pin",
    name="change_pin",
    dependencies=[Depends(requires("read"))],
    response_class=RedirectResponse,
    status_code=303,
)
def change_pin(request: Request, site: CurrentSite, person: SignedInPerson, password: Secret, pin: Pin) -> Response:
    """Set a new PIN."""
    try:
        site.people.check_password(person.account, password, on_screen_of(person))
        site.people.accounts.change_pin(person, pin)
    except (AccountError, SignInRefusedError) as error:
        if wants_json(request):
            raise
        return _own_account(request, site, person, problem=error, form="pin")
    return _go("/account?done=pin")


@router.post(
    "/account/screens/{screen}/end",
    name="end_screen",
    dependencies=[Depends(requires("read"))],
    response_class=RedirectResponse,
    status_code=303,
)
def end_screen(site: CurrentSite, person: SignedInPerson, screen: Annotated[str, Path(max_length=20)]) -> Response:
    """Sign out another screen of one's own."""
    site.people.end_screen(person, screen)
    return _go("/account?done=screen")


def _own_account(
    request: Request,
    site: CurrentSite,
    person: SignedInPerson,
    *,
    done: str = "",
    problem: OrthocaptureError | None = None,
    form: str = "",
) -> HTMLResponse:
    screens = [
        {"screen": screen.screen, "since": utc_of(screen.created_utc_s), "seen": utc_of(screen.seen_utc_s)}
        for screen in site.people.screens(person.account)
    ]
    return render(
        request,
        "people/account.html.j2",
        status=status_of(problem) if problem else 200,
        screens=screens,
        badge=site.people.accounts.get(person.account).badge,
        done=done,
        problem=problem,
        form=form,
    )
