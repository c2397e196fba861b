"""Every page in a real browser: accessible, not cut off, large enough, usable by keyboard, also without script."""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from fastapi.routing import iter_route_contexts
from playwright.sync_api import Browser, Page, Route, expect

from service.core.records.run_events import OperatorAction
from service.people.person import Role
from service.store.store import Store
from tests.support.pages.browser import (
    DESKTOP,
    TABLET,
    Screen,
    Served,
    accessibility_faults,
    press_until,
    screen,
    served,
)
from tests.support.pages.shown_site import ShownSite, shown_site
from tests.support.pages.web import PIN, password_of, web_site
from tests.support.runs.attended import attended

pytestmark = [pytest.mark.timeout(300)]

CHECKS = (Path(__file__).parents[1] / "support" / "pages" / "page_checks.js").read_text()
WIDTHS = (768, 1024, 1920, 3840)
ACCOUNTS: dict[Role, str] = {
    "technician": "grace",
    "supervisor": "emmy",
    "auditor": "lise",
    "administrator": "ada",
}
# Route → who looks, and at which pages: {completed} etc. are runs of ShownSite. Several addresses if they differ.
PAGES: dict[str, tuple[tuple[Role | None, str], ...]] = {
    "/sign-in": ((None, "/sign-in"),),
    "/set-up/{token}": ((None, "/set-up/{link}"),),
    "/unlock": (("technician", "/unlock"),),
    "/": (("technician", "/"), ("auditor", "/")),
    "/start": (("technician", "/start?protocol=bench.yaml"),),
    "/compare": (("auditor", "/compare?run={completed}&run={failed}"), ("auditor", "/compare")),
    "/history": (("auditor", "/history"),),
    "/account": (("technician", "/account"),),
    "/accounts": (("administrator", "/accounts"),),
    "/accounts/{account}": (("administrator", "/accounts/grace"),),
    "/runs/{run_id}": (
        ("technician", "/runs/{listing}"),
        ("technician", "/runs/{moving}"),
        ("technician", "/runs/{signing}"),
        ("technician", "/runs/{signing}?dialog=sign"),
        ("technician", "/runs/{failed}"),
        ("technician", "/runs/{acceptable}"),
        ("technician", "/runs/{acceptable}?dialog=accept"),
        ("technician", "/runs/{calibrated}"),
        ("technician", "/runs/{moving}?step=fixation"),
        ("technician", "/runs/{listing}?dialog=note"),
        ("supervisor", "/runs/{listing}"),
        ("auditor", "/runs/{completed}"),
    ),
    "/runs/{run_id}/capture": (
        ("technician", "/runs/{calibrated}/capture"),
        ("technician", "/runs/{completed}/capture?step=capture&viewpoint=v001"),
    ),
    "/runs/{run_id}/held": (
        ("technician", "/runs/{held}/held"),
        ("technician", "/runs/{completed}/held"),
    ),
    "/runs/{run_id}/checklist": (("technician", "/runs/{listing}/checklist"),),
    "/protocols/{file}/checklist": (("technician", "/protocols/bench.yaml/checklist"),),
    "/badges": (("supervisor", "/badges"), ("administrator", "/badges")),
    "/runs/{run_id}/scene": (("auditor", "/runs/{registered}/scene"),),
    "/runs/{run_id}/calibration": (("technician", "/runs/{calibrated}/calibration"),),
    "/runs/{run_id}/calibration/certificate": (("auditor", "/runs/{calibrated}/calibration/certificate"),),
    "/runs/{run_id}/dataset": (
        ("technician", "/runs/{listing}/dataset"),
        ("auditor", "/runs/{registered}/dataset"),  # whole ones: test_browser_dataset.py
    ),
    "/runs/{run_id}/exports": (
        ("supervisor", "/runs/{completed}/exports"),
        ("supervisor", "/runs/{registered}/exports"),
    ),
    "/audit": (("auditor", "/audit"),),
    "/audit/runs/{run_id}": (("auditor", "/audit/runs/{completed}"), ("supervisor", "/audit/runs/{registered}")),
    "/audit/runs/{run_id}/gates": (("auditor", "/audit/runs/{completed}/gates"),),
    "/audit/runs/{run_id}/deviations": (("auditor", "/audit/runs/{completed}/deviations"),),
    "/audit/runs/{run_id}/timeline": (("auditor", "/audit/runs/{completed}/timeline"),),
    "/audit/runs/{run_id}/events/{seq}": (("supervisor", "/audit/runs/{completed}/events/8"),),
    "/audit/runs/{run_id}/artefacts": (("auditor", "/audit/runs/{completed}/artefacts"),),
    "/audit/runs/{run_id}/artefacts/{sha256}": (("auditor", "/audit/runs/{completed}/artefacts/{image}"),),
    "/audit/runs/{run_id}/provenance": (("auditor", "/audit/runs/{registered}/provenance"),),
    "/audit/runs/{run_id}/corrections": (("supervisor", "/audit/runs/{completed}/corrections"),),
    "/audit/runs/{run_id}/signatures": (("auditor", "/audit/runs/{completed}/signatures"),),
    "/audit/runs/{run_id}/devices": (("auditor", "/audit/runs/{completed}/devices"),),
    "/audit/runs/{run_id}/verification": (("supervisor", "/audit/runs/{completed}/verification"),),
    "/audit/site": (("auditor", "/audit/site"),),
    "/audit/site/events/{seq}": (("auditor", "/audit/site/events/2"),),
}
# GET routes that are not pages.
NO_PAGES = {
    "/vendor/plotly.js",
    "/health",  # for machines
    "/metrics",
    "/robots",
    "/history.csv",
    "/runs/{run_id}/parts/{names}",
    "/runs/{run_id}/capture/parts/{names}",
    "/runs/{run_id}/held/parts/{names}",
    "/runs/{run_id}/board-plan.svg",
    "/runs/{run_id}/scene/frame",  # sandboxed within its page, and checked there
    "/runs/{run_id}/stream",
    "/runs/{run_id}/files/{sha256}",
    "/runs/{run_id}/images/{viewpoint}",
    "/runs/{run_id}/live-view",
    "/runs/{run_id}/exports/{file_name}",
    "/runs/{run_id}/dataset/pictures/{name}",
    "/runs/{run_id}/dataset/{figure}/frame",
}
STANDING = {"doing": "asking", "robot": "standing", "robot_name": "robot", "light_lux": 800.0}
WORKING = {"doing": "working", "robot": "moving", "what": "image", "done": 1, "total": 4}
HOLDING = {"doing": "working", "what": "waiting for the next image", "done": 4, "total": 7}
# One view of each layout, which is looked at in every submission; of the others a tenth are drawn.
ALWAYS = (
    "/sign-in",
    "/start?protocol=bench.yaml",
    "/runs/{moving}",
    "/runs/{acceptable}?dialog=accept",
    "/runs/{calibrated}/capture",
    "/runs/{registered}/scene",
    "/runs/{completed}/exports",
    "/audit/runs/{completed}/gates",
)
VIEWS = [
    pytest.param(role, path, id=f"{role}:{path}", marks=pytest.mark.sweep(always=path in ALWAYS))
    for views in PAGES.values()
    for role, path in views
]


@dataclass
class Desk:
    """One browser, one server, and a screen for each role used."""

    browser: Browser
    server: Served
    site: ShownSite
    names: dict[str, str]
    open_screens: contextlib.ExitStack
    screens: dict[Role | None, Screen] = field(default_factory=dict[Role | None, Screen])
    complaints: list[str] = field(default_factory=list[str])

    def screen(self, role: Role | None) -> Screen:
        """A tablet with a person of that role; the technician's controls the runs in progress."""
        if role not in self.screens:
            shown = self.open_screens.enter_context(screen(self.browser, self.server.url))
            self.screens[role] = shown
            if role is not None:
                shown.sign_in(ACCOUNTS[role], password_of(ACCOUNTS[role]))
            shown.page.on("request", lambda request: self._asked(request.url))
            shown.page.on("console", lambda message: self._said(message.type, message.text))
            if role == "technician":
                for run_id in self.site.under_way:
                    shown.go(f"/runs/{run_id}")
                    shown.page.get_by_role("button", name=re.compile("Take control")).first.click()
                    expect(shown.page.get_by_role("button", name=re.compile("End run")).first).to_be_visible()
        return self.screens[role]

    def address(self, path: str) -> str:
        return path.format(**self.names)

    @contextlib.contextmanager
    def attending(self, path: str) -> Generator[str]:
        """Yield the address; the run in progress to which it belongs is driven meanwhile, alone on its rig."""
        address = self.address(path)
        runs = {run_id: STANDING for run_id in self.site.under_way if run_id in address}
        if self.site.calibrated in runs:
            runs[self.site.calibrated] = STANDING | WORKING
        if self.site.held in runs:
            runs[self.site.held] = STANDING | HOLDING
        with attended(self.server.data, runs):
            yield address

    def _asked(self, url: str) -> None:
        if not url.startswith((self.server.url + "/", "data:", "blob:", "about:")):
            self.complaints.append(f"asks another host: {url}")

    def _said(self, kind: str, text: str) -> None:
        if kind == "error":
            self.complaints.append(text)


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory, browser: Browser) -> Iterator[Desk]:
    folder = tmp_path_factory.mktemp("shown")
    site = shown_site(folder)
    data = folder / "data"
    with Store.open(data) as store:
        image = next(a.ref.sha256 for a in store.artefacts(site.completed) if a.ref.kind == "image")
    names = {name: str(getattr(site, name)) for name in ShownSite.__dataclass_fields__}
    names |= {"image": image, "link": invitation(folder)}
    with (
        served(folder / "rig.yaml", data, "--protocols", str(folder / "protocols")) as server,
        contextlib.ExitStack() as screens,
    ):
        yield Desk(browser, server, site, names, screens)


def invitation(folder: Path) -> str:
    """The token of a one-time link."""
    with web_site(folder) as web:
        browser = web.browser("administrator")
        return web.people.accounts.invite(browser.person, "tom", "Tom Example", "technician")


def test_no_page_is_forgotten(tmp_path: Path) -> None:
    with web_site(tmp_path) as web:
        routes = {c.path for c in iter_route_contexts(web.app.routes) if c.methods is not None and "GET" in c.methods}
    assert routes == set(PAGES) | NO_PAGES
    assert set(ALWAYS) <= {path for views in PAGES.values() for _, path in views}


@pytest.mark.slow
@pytest.mark.parametrize(("role", "path"), VIEWS)
def test_page(desk: Desk, role: Role | None, path: str) -> None:
    """One load: axe, sizes, horizontal scrolling, keys, and the page's requests and complaints."""
    shown = desk.screen(role)
    page = shown.page
    page.emulate_media(color_scheme="light")
    page.set_viewport_size({"width": TABLET[0], "height": TABLET[1]})
    del desk.complaints[:]
    with desk.attending(path) as address:
        shown.go(address)
        faults = page_faults(page)
    assert faults + desk.complaints == []


def page_faults(page: Page) -> list[str]:
    """The faults of the loaded page."""
    page.evaluate(CHECKS)
    faults = [f"light tablet: {fault}" for fault in accessibility_faults(page)]
    faults += [f"too small: {fault}" for fault in page.evaluate("check.small()")]
    if page.locator("dialog:modal").count() == 0:
        faults += tab_faults(page)
    for width in WIDTHS:
        page.set_viewport_size({"width": width, "height": DESKTOP[1]})
        faults += [f"sideways at {width} px: {fault}" for fault in page.evaluate("check.sideways()")]
    page.set_viewport_size({"width": DESKTOP[0], "height": DESKTOP[1]})
    page.emulate_media(color_scheme="dark")
    return faults + [f"dark desktop: {fault}" for fault in accessibility_faults(page)]


def tab_faults(page: Page) -> list[str]:
    """Controls that Tab does not reach, that show no focus, or that come out of order."""
    count, faults = page.evaluate("check.follow()"), []
    for _ in range(6):  # a date has several stops, and a frame has its own controls
        for _ in range(count + 3):
            page.keyboard.press("Tab")
        faults = page.evaluate("check.way()")
        if not any("not reached" in fault for fault in faults):
            break
        count = 15
    page.evaluate("document.activeElement.blur()")
    return faults


@pytest.mark.slow
@pytest.mark.parametrize(
    ("run", "opener"),
    [
        pytest.param("listing", "End run…", marks=pytest.mark.sweep),
        pytest.param("listing", "Skip…", marks=pytest.mark.sweep),
        ("signing", "Sign: spray"),
        pytest.param("signing", "Redo…", marks=pytest.mark.sweep),
        pytest.param("acceptable", "Accept…", marks=pytest.mark.sweep),
    ],
)
def test_a_dialog_holds_the_focus_and_gives_it_back(desk: Desk, run: str, opener: str) -> None:
    shown = desk.screen("technician")
    page = shown.page
    with desk.attending(f"/runs/{{{run}}}") as address:
        shown.go(address)
        page.evaluate(CHECKS)
        button = page.get_by_role("button", name=opener).first
        button.focus()
        page.keyboard.press("Enter")
        expect(page.locator("dialog:modal")).to_be_visible()
        assert page.evaluate("document.querySelector('dialog:modal').contains(document.activeElement)")
        assert accessibility_faults(page) == []
        assert page.evaluate("check.small()") == []
        for _ in range(12):
            page.keyboard.press("Tab")
            assert page.evaluate("check.behind()")
        page.keyboard.press("Escape")
        expect(page.locator("dialog:modal")).to_have_count(0)
        expect(button).to_be_focused()


@pytest.mark.slow
def test_a_locked_screen_is_unlocked_by_keys_and_cannot_be_escaped(desk: Desk) -> None:
    shown = desk.screen("technician")
    page = shown.page
    with desk.attending("/runs/{listing}") as address:
        shown.go(address)
        pin = page.get_by_label("PIN", exact=True)
        press_until(page.get_by_role("button", name="Lock"), pin.is_visible)
        expect(pin).to_be_focused()
        assert accessibility_faults(page) == []
        page.keyboard.press("Escape")
        expect(pin).to_be_visible()
        page.keyboard.type(PIN)
        page.keyboard.press("Enter")
        expect(pin).to_be_hidden()


def test_nothing_moves_on_the_page_for_who_wants_no_motion(desk: Desk) -> None:
    shown = desk.screen("technician")
    shown.page.emulate_media(reduced_motion="no-preference")
    with desk.attending("/runs/{calibrated}") as address:
        shown.go(address)
        moving = "document.getAnimations().length"
        assert shown.page.evaluate(moving) > 0
        shown.page.emulate_media(reduced_motion="reduce")
        assert shown.page.evaluate(moving) == 0


@pytest.mark.slow
def test_a_motion_is_confirmed_with_a_held_key_only(desk: Desk) -> None:
    shown = desk.screen("technician")
    page = shown.page
    with desk.attending("/runs/{moving}") as address:
        shown.go(address)
        go = page.get_by_role("button", name=re.compile("Confirm: the robot takes"))
        expect(go).to_be_enabled()
        go.focus()
        page.keyboard.press("Enter")
        page.keyboard.down("Enter")
        page.wait_for_timeout(800)
        page.keyboard.up("Enter")
        assert "confirm" not in actions(desk, desk.site.moving)
        press_until(go, lambda: go.count() == 0, hold_ms=2500)
        assert actions(desk, desk.site.moving).count("confirm") == 1


@pytest.mark.slow
def test_a_checklist_is_worked_through_without_script(desk: Desk) -> None:
    with plain_page(desk.browser, desk.server.url) as page, desk.attending("/runs/{listing}") as address:
        page.goto("/sign-in")
        page.get_by_label("Account").fill("grace")
        page.get_by_label("Password").fill(password_of("grace"))
        page.get_by_role("button", name="Sign in").click()
        page.goto(address)
        page.get_by_role("button", name="Take control here").click()
        page.get_by_role("checkbox", name=re.compile("board lies")).click()
        expect(page.locator("[aria-checked=true]")).to_have_count(2)
        page.get_by_role("button", name=re.compile("^Confirm")).click()
        assert actions(desk, desk.site.listing) == ["confirm"]
        page.get_by_role("button", name="Sign out").click()
        expect(page.get_by_role("button", name="Sign in")).to_be_visible()
        page.goto(address)
        expect(page.get_by_role("button", name="Sign in")).to_be_visible()


@pytest.mark.slow
def test_a_page_that_cannot_fetch_the_news_says_so_and_goes_on_trying(desk: Desk) -> None:
    """A run that waits for a person sends no more updates, so a page would never show one that it missed."""
    asked: list[Route] = []
    repaired = threading.Event()

    def answer(route: Route) -> None:
        asked.append(route)
        if repaired.is_set():
            route.continue_()
        elif len(asked) > 1:  # the first is never answered
            route.fulfill(status=503)

    fields = dict(STANDING)
    run = desk.site.moving
    with screen(desk.browser, desk.server.url) as shown, attended(desk.server.data, {run: fields}):
        shown.sign_in(ACCOUNTS["auditor"], password_of(ACCOUNTS["auditor"]))
        shown.go(f"/runs/{run}")
        banner = shown.page.locator("#robot-banner")
        expect(banner).to_contain_text(re.compile("stands", re.IGNORECASE))
        shown.page.wait_for_timeout(1_000)  # for the page's own first request
        shown.page.route("**/parts/**", answer)
        fields.update(WORKING)
        lost = shown.page.get_by_text("Connection lost")
        expect(lost).to_be_visible(timeout=40_000)
        repaired.set()
        expect(lost).to_be_hidden(timeout=20_000)
        expect(banner).to_contain_text(re.compile("moves", re.IGNORECASE))


def actions(desk: Desk, run_id: str) -> list[str]:
    """What people have done in the run, except for skipped steps."""
    with Store.open(desk.server.data) as store:
        payloads = [event.payload for event in store.events(run_id)]
    return [p.action for p in payloads if isinstance(p, OperatorAction) and p.action != "skip"]


@contextlib.contextmanager
def plain_page(browser: Browser, url: str) -> Generator[Page]:
    """A browser with scripts disabled."""
    context = browser.new_context(
        viewport={"width": TABLET[0], "height": TABLET[1]}, java_script_enabled=False, base_url=url
    )
    try:
        yield context.new_page()
    finally:
        context.close()
