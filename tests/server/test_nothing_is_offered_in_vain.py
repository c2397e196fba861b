"""Every role on every page: whatever is offered there, the role may do; no way leads to a refusal of the role."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import lru_cache
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import urljoin, urlsplit

import httpx
import pytest

from service.people.person import ROLES, Role, may
from tests.support.pages.shown_site import ShownSite, shown_site
from tests.support.pages.web import HOST, PIN, Browser, WebSite, password_of, web_site
from tests.support.record.outsider import copy_data

_PAGES_OF_A_RUN = (
    "/runs/{}", "/runs/{}/capture", "/runs/{}/scene", "/runs/{}/calibration", "/runs/{}/dataset", "/runs/{}/exports",
    "/runs/{}/checklist", "/audit/runs/{}",
)  # fmt: skip
_PAGES_OF_AN_AUDIT = (
    "/audit/runs/{}/deviations", "/audit/runs/{}/gates", "/audit/runs/{}/timeline", "/audit/runs/{}/events/1",
    "/audit/runs/{}/corrections", "/audit/runs/{}/signatures", "/audit/runs/{}/devices",
    "/audit/runs/{}/verification",
)  # fmt: skip
_PAGES = ("/", "/history", "/audit", "/account", "/compare", "/start?protocol=bench.yaml")
# What ends or locks this screen, or another one of the same person.
_ENDING = ("/lock", "/sign-out", "/account/")
_OFFERED = re.compile(r"<form\b.*?</form>|<a\b[^>]*>", re.DOTALL)
# What a page would say to a role for which it has nothing: no button may lead there.
_IN_VAIN = re.compile(r"[Aa] supervisor can|may not do this|Technicians and supervisors start runs|makes no exports")


class _Offers(HTMLParser):
    """The forms of a page with their fields and buttons, and the links that look like buttons."""

    def __init__(self) -> None:
        super().__init__()
        self.forms: list[tuple[str, dict[str, str], list[dict[str, str]]]] = []
        self.ways: list[str] = []
        self._open = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        named = {name: value or "" for name, value in attrs}
        if tag == "form" and named.get("method", "").lower() == "post":
            self.forms.append((named.get("action", ""), {}, []))
            self._open = True
        elif tag == "a" and "button" in named.get("class", "").split():
            self.ways.append(named.get("href", ""))
        elif self._open and named.get("name"):
            _action, fields, buttons = self.forms[-1]
            if tag == "button":
                buttons.append({named["name"]: named.get("value", "")})
            elif tag in ("input", "textarea") and named.get("type") not in ("radio", "checkbox", "file"):
                fields[named["name"]] = named.get("value", "")

    def handle_endtag(self, tag: str) -> None:
        if tag == "form":
            self._open = False


@lru_cache(maxsize=256)
def _offers(page: str) -> _Offers:
    found = _Offers()
    found.feed("".join(_OFFERED.findall(page)))  # a small part of it: to parse the rest takes longer than to serve it
    return found


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> ShownSite:
    return shown_site(tmp_path_factory.mktemp("offers"))


@pytest.fixture
def web(shown: ShownSite, tmp_path: Path) -> Iterator[WebSite]:
    """A copy of its own for each role, since what is offered is also done."""
    with web_site(copy_data(shown.folder, tmp_path / "site")) as made:
        for run_id in shown.under_way:
            made.site.launcher.start(run_id)
        yield made
        for row in made.store.runs():  # what was begun in passing
            for begun in (made.app.state.exports, made.app.state.audit.verifications):
                begun.wait(row.run_id, 60)


def _pages(shown: ShownSite) -> list[str]:
    runs = (shown.listing, shown.signing, shown.acceptable, shown.held, shown.completed)
    audits = [page.format(run) for run in (shown.listing, shown.completed) for page in _PAGES_OF_AN_AUDIT]
    return [*_PAGES, *(page.format(run) for run in runs for page in _PAGES_OF_A_RUN), *audits]


@pytest.mark.slow
@pytest.mark.parametrize(
    "role", [pytest.param(role, marks=pytest.mark.sweep(always=role == "technician")) for role in ROLES]
)
def test_a_role_may_what_it_is_offered_and_no_button_leads_where_it_has_nothing(
    web: WebSite, shown: ShownSite, role: Role
) -> None:
    browser = web.browser(role)
    for run_id in shown.under_way if may(role, "operate") else ():
        web.take_control(run_id, browser)
    shown_pages = {page: browser.get(page) for page in _pages(shown)}
    assert {page: answer.status_code for page, answer in shown_pages.items() if answer.status_code != 200} == {}
    _follow(browser, shown_pages, makes_exports=may(role, "report"))
    acting = web.browser(role)  # another screen of the same person, for what ends or locks it
    offered = _offered(shown_pages)
    verbs = {dict(fields).get("verb") for _, fields in offered}
    assert ("confirm" in verbs) == may(role, "operate")
    for (action, fields), page in offered.items():
        answer = _send(acting, action, dict(fields), web.account(role))
        assert answer.status_code != 403 or "may not" not in answer.text, (page, action, fields, answer.text)
        assert answer.status_code not in (401, 500), (page, action, answer.status_code)
        if action.startswith(_ENDING):
            acting = web.browser(role)


def _follow(browser: Browser, shown_pages: dict[str, httpx.Response], *, makes_exports: bool) -> None:
    """Go where each button leads: no page there says that this role has nothing there."""
    led: dict[str, str] = {}  # address → page with a button that leads there
    for page, answer in shown_pages.items():
        for way in _offers(answer.text).ways:
            there = urlsplit(urljoin(str(answer.url), way))
            led.setdefault(there._replace(fragment="").geturl().removeprefix(HOST), page)
    assert len(led) > 20
    for address, page in led.items():
        answer = shown_pages.get(address) or browser.get(address)
        assert answer.status_code not in (401, 403, 404, 500), (page, address, answer.status_code)
        lists_files = "/exports" in address and not makes_exports  # where this role fetches what others have made
        assert lists_files or not _IN_VAIN.search(answer.text), (page, address)
        assert "a supervisor can" not in answer.text.lower(), (page, address)


def _offered(shown_pages: dict[str, httpx.Response]) -> dict[tuple[str, tuple[tuple[str, str], ...]], str]:
    """Every form with each of its buttons, and a page that has it; what ends a screen is last."""
    found: dict[tuple[str, tuple[tuple[str, str], ...]], str] = {}
    for page, answer in shown_pages.items():
        for action, fields, buttons in _offers(answer.text).forms:
            for button in buttons or [{}]:
                sent = {name: value for name, value in (fields | button).items() if name not in ("csrf", "seen_seq")}
                found.setdefault((action, tuple(sorted(sent.items()))), page)
    return dict(sorted(found.items(), key=lambda one: one[0][0].startswith(_ENDING)))


def _send(browser: Browser, action: str, fields: dict[str, str], account: str) -> httpx.Response:
    """Send a form as offered, with something in each field that is empty."""
    filled = {name: value or _typed(name, account) for name, value in fields.items()}
    return browser.post(
        action, data={"csrf": browser.person.csrf, **filled}, headers={"accept": "application/json"},
        follow_redirects=False,
    )  # fmt: skip


def _typed(name: str, account: str) -> str:
    if "password" in name:
        return password_of(account)
    return {"pin": PIN, "account": account, "new_pin": PIN}.get(name, "x")
