"""Every route of the application with every role: who may, who may not, and what a locked screen may still do."""

from __future__ import annotations

import re
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI
from fastapi.routing import APIRoute, iter_route_contexts
from starlette.routing import Route

from service.people.person import ROLES, Permission, Role, may
from service.store.records import SITE
from service.web.security import Guard
from tests.support.pages.web import Browser, WebSite, web_site

# What people who are not signed in may request. Everything else has a guard.
PUBLIC = {
    ("GET", "/sign-in"),
    ("POST", "/sign-in"),
    ("GET", "/set-up/{token}"),
    ("POST", "/set-up/{token}"),
    ("GET", "/vendor/plotly.js"),
    ("GET", "/health"),
}
# What a locked screen may do besides looking.
OPEN_WHILE_LOCKED = {("POST", "/sign-out"), ("POST", "/lock"), ("POST", "/unlock"), ("POST", "/theme")}
ENDLESS = ("/runs/{run_id}/stream", "/runs/{run_id}/live-view")


@dataclass(frozen=True)
class Way:
    """A method of a route and its required permission; "" for a public one."""

    method: str
    path: str
    permission: Permission | None
    guards: int

    @property
    def key(self) -> tuple[str, str]:
        return self.method, self.path

    def address(self, run_id: str) -> str:
        """The address with the run's id, and with non-existent values for everything else."""
        # Streams never end by themselves, so they are requested for a run that does not exist.
        run = "nowhere" if self.path in ENDLESS else run_id
        return re.sub(r"{[^}]*}", "1", self.path.replace("{run_id}", run))


def ways(app: FastAPI) -> list[Way]:
    """Every method of every route, except for mounted files."""
    found: list[Way] = []
    for context in iter_route_contexts(app.routes):
        if not context.path or context.methods is None:
            continue  # /static
        route = context.original_route
        assert isinstance(route, Route)
        dependant = context.dependant if isinstance(route, APIRoute) else None
        guards = [d.call for d in dependant.dependencies if isinstance(d.call, Guard)] if dependant else []
        permission = guards[0].permission if guards else None
        found += [
            Way(method, context.path, permission, len(guards)) for method in context.methods if method != "HEAD"
        ]
    return found


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Generator[WebSite]:
    with web_site(tmp_path_factory.mktemp("roles")) as site:
        yield site


@pytest.fixture(scope="module")
def run_id(site: WebSite) -> str:
    return site.record_run()


def ask(browser: Browser, way: Way, run_id: str, *, csrf: str = "", **headers: str) -> httpx.Response:
    """A request with nothing but the token of its form."""
    data = {"csrf": csrf} if way.method != "GET" and csrf else None
    headers = {"accept": "application/json", **headers}
    return browser.request(way.method, way.address(run_id), data=data, headers=headers, follow_redirects=False)


def events_of(site: WebSite, run_id: str) -> tuple[int, int]:
    """How many events the chains of the run and of the site have."""
    return site.store.head(run_id), site.store.head(SITE)


def is_refused_by_role(answer: httpx.Response) -> bool:
    return answer.status_code == 403 and "may not do this" in answer.text


def test_every_route_has_one_guard_or_is_public(site: WebSite) -> None:
    found = ways(site.app)
    assert len(found) > 40
    wrong = [way.key for way in found if way.guards != (0 if way.key in PUBLIC else 1)]
    assert wrong == []


def test_whatever_changes_something_is_not_a_get(site: WebSite) -> None:
    assert {way.method for way in ways(site.app)} == {"GET", "POST"}
    acting = [way.key for way in ways(site.app) if way.method == "GET" and way.permission not in (None, "read")]
    assert [key for key in acting if not key[1].startswith(("/accounts", "/badges"))] == []


def test_nobody_gets_in_without_signing_in(site: WebSite, run_id: str) -> None:
    browser = site.browser()
    before = events_of(site, run_id)
    for way in ways(site.app):
        if way.key in PUBLIC:
            continue
        assert ask(browser, way, run_id).status_code == 401, way
        page = ask(browser, way, run_id, accept="text/html")
        if way.method == "GET":
            assert page.status_code == 303, way
            assert page.headers["location"].startswith("/sign-in?next=/"), way
        else:
            assert page.status_code == 401, way
    assert events_of(site, run_id) == before


@pytest.mark.slow
@pytest.mark.parametrize("role", ROLES)
def test_each_role_may_what_the_table_says_and_nothing_else(site: WebSite, run_id: str, role: Role) -> None:
    browser = site.browser(role)
    for way in ways(site.app):
        if way.permission is None:
            continue
        if may(role, way.permission):
            if way.method == "GET":  # POSTs have effects and are tested elsewhere; their guard is tested below
                answer = ask(browser, way, run_id)
                assert answer.status_code not in (401, 403, 423, 500), (way, answer.text)
        else:
            before = events_of(site, run_id)
            answer = ask(browser, way, run_id, csrf=browser.person.csrf)
            assert is_refused_by_role(answer), (way, answer.status_code, answer.text)
            assert events_of(site, run_id) == before, way


@pytest.mark.parametrize("role", ROLES)
def test_a_form_of_an_allowed_role_gets_past_the_guard(site: WebSite, run_id: str, role: Role) -> None:
    """On a run that has ended, with an empty form: only the handler itself can refuse it."""
    for way in ways(site.app):
        if way.method == "POST" and way.permission is not None and may(role, way.permission):
            browser = site.browser(role)  # a separate screen, since one of the forms signs it out
            answer = ask(browser, way, run_id, csrf=browser.person.csrf)
            assert not is_refused_by_role(answer), (way, answer.text)
            assert answer.status_code not in (401, 423, 500), (way, answer.status_code, answer.text)


@pytest.mark.slow
def test_a_form_without_the_token_of_its_sign_in_is_refused(site: WebSite, run_id: str) -> None:
    other = site.browser("supervisor").person.csrf
    for role in ROLES:
        browser = site.browser(role)
        for way in ways(site.app):
            if way.method != "POST" or way.permission is None or not may(role, way.permission):
                continue
            before = events_of(site, run_id)
            for csrf in ("", "wrong", other, "ü" * 43):
                answer = ask(browser, way, run_id, csrf=csrf)
                assert answer.status_code == 403, (way, csrf, answer.text)
                assert "does not belong to the current sign-in" in answer.text, way
            assert events_of(site, run_id) == before, way


@pytest.mark.parametrize(
    "foreign",
    [
        {"origin": "https://elsewhere.example"},
        {"origin": "null"},
        {"origin": "https://testserver.elsewhere.example"},
        {"origin": "https://testserver:8443"},
        {"sec-fetch-site": "cross-site"},
        {"sec-fetch-site": "same-site"},
    ],
)
def test_a_form_from_another_site_is_refused_whatever_it_carries(
    site: WebSite, run_id: str, foreign: dict[str, str]
) -> None:
    browser = site.browser("supervisor")
    csrf = browser.person.csrf
    before = events_of(site, run_id)
    for way in ways(site.app):
        if way.method == "POST":
            answer = ask(browser, way, run_id, csrf=csrf, **foreign)
            assert answer.status_code == 403, way
            assert "another site" in answer.text, way
    assert events_of(site, run_id) == before


@pytest.mark.parametrize("role", ROLES)
def test_a_locked_screen_looks_on(site: WebSite, run_id: str, role: Role) -> None:
    browser = site.browser(role)
    site.people.lock(browser.person)
    csrf = browser.person.csrf
    before = events_of(site, run_id)
    for way in ways(site.app):
        if way.permission is None or not may(role, way.permission) or way.key in OPEN_WHILE_LOCKED:
            continue
        answer = ask(browser, way, run_id, csrf=csrf)
        if way.method == "GET" and way.permission == "read":
            assert answer.status_code != 423, way
        else:
            assert answer.status_code == 423, (way, answer.text)
    assert events_of(site, run_id) == before


def test_a_locked_screen_may_still_pause(site: WebSite) -> None:
    bench = site.begin_run()
    browser = site.browser("technician")
    site.take_control(bench.run_id, browser)
    site.people.lock(browser.person)
    address = f"/runs/{bench.run_id}/actions"
    assert browser.send_form(address, verb="confirm", step="fixation", attempt=1).status_code == 423
    assert browser.send_form(address, verb="resume").status_code == 423
    assert not bench.state().paused
    assert browser.send_form(address, verb="pause").status_code == 303
    assert bench.state().paused
    assert browser.send_form(address, verb="pause", csrf="wrong").status_code == 403


def test_the_auditor_leaves_no_trace_in_a_run(site: WebSite, run_id: str, tmp_path: Path) -> None:
    browser = site.browser("auditor")
    csrf = browser.person.csrf
    before = site.store.events(run_id)
    for way in ways(site.app):
        if way.path.startswith("/runs") or way.path.startswith("/audit/runs"):
            ask(browser, way, run_id, csrf=csrf)
    assert site.store.events(run_id) == before
