"""Signing in and out, one-time links, the screen's lock, and a person's own account."""

from __future__ import annotations

from typing import Annotated, cast

from fastapi import APIRouter, Depends, Form, Path, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from pydantic import BaseModel, Field

from service.core.errors import OrthocaptureError
from service.people.credentials import on_screen_of
from service.people.person import AccountError, AccountJustChangedError, SignInRefusedError
from service.web.page.rendering import render, status_of, wants_json
from service.web.people import administration
from service.web.people.administration import utc_of
from service.web.security import Limiter, SignedInPerson, clear_cookie, requires, set_cookie, token_of
from service.web.site import CurrentSite

router = APIRouter(tags=["people"])
router.include_router(administration.router)

Name = Annotated[str, Form(max_length=80)]
Secret = Annotated[str, Form(max_length=256)]
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
