"""In a real browser: every control can be read in every state, in light and dark."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, CDPSession, Page, Route

from service.people.person import Role
from tests.support.pages.browser import TABLET
from tests.support.pages.states import (
    Seen,
    about_to_move,
    asked_for_control,
    by_hand,
    capturing,
    looking_on,
    paused,
    stopped,
    to_sign,
    waiting_for_an_answer,
)
from tests.support.pages.web import Browser as Desk
from tests.support.pages.web import WebSite, web_site

pytestmark = [pytest.mark.timeout(300)]
LEAST = 4.5  # WCAG 2.2 AA, for states that it exempts as well
CONTROLS = "button, a, summary, input, select, textarea, label"
POINTED: dict[str, list[str]] = {
    "": [],
    "hover": ["hover"],
    "pressed": ["hover", "active"],
    "focus": ["focus", "focus-visible"],
}
MEASURE = (Path(__file__).parents[1] / "support/pages/contrast.js").read_text()


@pytest.fixture(scope="module")
def page(browser: Browser) -> Iterator[Page]:
    """A page without script: what it shows stays as it came."""
    context = browser.new_context(viewport={"width": TABLET[0], "height": TABLET[1]})
    yield context.new_page()
    context.close()


def show(page: Page, desk: Desk, address: str) -> None:
    """Open a page of the application in this process, with every dialog and detail of it open."""

    def answer(route: Route) -> None:
        path = urlsplit(route.request.url)
        if path.path.endswith(".js") or route.request.resource_type == "image":
            route.abort()
            return
        got = desk.get(f"{path.path}?{path.query}")
        route.fulfill(status=got.status_code, headers=dict(got.headers), body=got.content)

    page.unroute_all()
    page.route("**/*", answer)
    response = page.goto(f"https://testserver{address}")
    assert response is not None
    assert response.ok, f"{address}: {response.status}"
    page.evaluate(MEASURE)


def point(session: CDPSession, nodes: Sequence[int], classes: Sequence[str]) -> None:
    for node in nodes:
        session.send("CSS.forcePseudoState", {"nodeId": node, "forcedPseudoClasses": list(classes)})


def faults(page: Page) -> list[str]:
    """The controls of the page that cannot be read in one of the states, in one of the themes."""
    session = page.context.new_cdp_session(page)
    for domain in ("DOM", "CSS"):
        session.send(f"{domain}.enable")
    root: dict[str, Any] = session.send("DOM.getDocument", {"depth": 0})
    asked = {"nodeId": root["root"]["nodeId"], "selector": CONTROLS}
    nodes: list[int] = session.send("DOM.querySelectorAll", asked)["nodeIds"]
    found: list[str] = []
    for name, classes in POINTED.items():
        point(session, nodes, classes)
        found += [f"{name} {fault}" for fault in page.evaluate("(least) => tooFaint(least)", LEAST)]
    session.detach()
    return found


RUN_PAGES: tuple[tuple[Callable[[WebSite], Seen], str], ...] = (
    (about_to_move, "/runs/{run}"),
    (paused, "/runs/{run}"),
    (stopped, "/runs/{run}"),
    (to_sign, "/runs/{run}"),
    (asked_for_control, "/runs/{run}"),
    (looking_on, "/runs/{run}"),
    (waiting_for_an_answer, "/runs/{run}"),
    (capturing, "/runs/{run}/capture"),
)
OTHER_PAGES: tuple[tuple[Role, str], ...] = (
    ("technician", "/"),
    ("technician", "/start?protocol=bench.yaml"),
    ("technician", "/account"),
    ("administrator", "/accounts"),
    ("administrator", "/accounts/grace"),
    ("auditor", "/audit"),
    ("auditor", "/audit/site"),
)


@pytest.mark.slow
@pytest.mark.parametrize(
    "shown",
    [
        pytest.param(
            (state, path), id=f"{state.__name__}{path[11:]}", marks=pytest.mark.sweep(always=state is about_to_move)
        )
        for state, path in RUN_PAGES
    ],
)
def test_every_control_of_a_run_can_be_read_in_every_state(
    page: Page, tmp_path: Path, shown: tuple[Callable[[WebSite], Seen], str]
) -> None:
    state, address = shown
    with web_site(tmp_path) as web:
        seen = state(web)
        show(page, seen.browser, address.format(run=seen.run))
        assert faults(page) == []


@pytest.mark.slow
def test_every_control_of_a_capture_by_hand_can_be_read_in_every_state(page: Page, tmp_path: Path) -> None:
    with ExitStack() as open_, web_site(tmp_path) as web:
        seen = open_.enter_context(by_hand(tmp_path, web))
        show(page, seen.browser, f"/runs/{seen.run}/held")
        assert faults(page) == []


def test_every_control_of_other_pages_can_be_read_in_every_state(page: Page, tmp_path: Path) -> None:
    with web_site(tmp_path) as web:
        run = web.record_run()
        found: list[str] = []
        of_run: tuple[tuple[Role, str], ...] = (
            ("supervisor", f"/runs/{run}/exports"),
            ("auditor", f"/audit/runs/{run}"),
        )
        for role, address in (*OTHER_PAGES, *of_run):
            show(page, web.browser(role), address)
            found += [f"{address}: {fault}" for fault in faults(page)]
        show(page, web.browser(), "/sign-in")
        assert [*found, *faults(page)] == []
