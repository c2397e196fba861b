"""The robot's state stays visible in a real browser, however far a page is scrolled and whatever step comes up."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Page, expect

from service.core.records.events import OperatorAction, StepFailed, StepStarted
from tests.support.pages.at_the_table import at_the_table, record
from tests.support.pages.browser import Served, served
from tests.support.pages.shown_site import skip
from tests.support.pages.web import web_site

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("sight")
    with web_site(folder):  # creates its people
        pass
    with served(folder / "rig.yaml", folder / "data", "--protocols", str(folder / "protocols")) as running:
        yield running


def in_sight(page: Page, selector: str) -> bool:
    """Whether an element lies entirely in the window and nothing covers its centre."""
    return page.evaluate(
        """(selector) => {
            const e = document.querySelector(selector), b = e.getBoundingClientRect();
            const on_top = document.elementFromPoint((b.left + b.right) / 2, (b.top + b.bottom) / 2);
            return b.top >= 0 && b.bottom <= innerHeight && b.height > 20 && e.contains(on_top);
        }""",
        selector,
    )


def scrolled(page: Page) -> float:
    return page.evaluate("scrollY")


def test_the_banner_stays_and_a_new_step_begins_at_its_head(server: Served, browser: Browser) -> None:
    with at_the_table(server, browser) as (tablet, run_id):
        page = tablet.page
        page.evaluate("document.querySelector('main').style.paddingBottom = '1500px'")
        page.evaluate("window.scrollTo(0, 900)")
        assert scrolled(page) > 500
        assert in_sight(page, "#robot-banner .robot-banner")
        record(server, run_id, skip("fixation"))
        title = page.get_by_role("heading", name="Capture", level=1)
        expect(title).to_be_focused(timeout=20_000)
        assert scrolled(page) == 0
        assert in_sight(page, "#robot-banner .robot-banner")
        assert in_sight(page, ".step-head h1")
        # The same for a stopped step: what happened is above what can be done about it.
        page.evaluate("window.scrollTo(0, 900)")
        page.get_by_role("button", name="Pause").focus()
        failed = StepFailed(step="capture", attempt=1, error="DeviceError", message="no link", recovery="ask")
        go = OperatorAction(action="confirm", step="capture")
        record(server, run_id, go, StepStarted(step="capture", attempt=1), failed)
        expect(page.get_by_role("heading", name="Capture did not work")).to_be_visible(timeout=20_000)
        expect(title).to_be_focused()
        assert scrolled(page) == 0


def test_a_page_that_is_no_runs_keeps_the_robots_in_sight(server: Served, browser: Browser) -> None:
    with at_the_table(server, browser) as (tablet, _run_id):
        tablet.go("/account")
        tablet.page.evaluate("document.querySelector('main').style.paddingBottom = '1500px'")
        tablet.page.evaluate("window.scrollTo(0, 900)")
        assert in_sight(tablet.page, "#robots .robot-banner")


HEARD = """() => {
    window.heard = []; window.noted = [];
    window.AudioContext = class {
        currentTime = 0; destination = {};
        resume() {}
        createOscillator() {
            return { frequency: {}, connect: (to) => to, start() { heard.push(this.frequency.value); }, stop() {} };
        }
        createGain() {
            return { gain: { setValueAtTime() {}, linearRampToValueAtTime() {} }, connect: (to) => to };
        }
    };
    window.Notification = class {
        static permission = "granted";
        constructor(title, more) { noted.push([title, more.body]); }
        addEventListener() {}
    };
}"""


def test_sound_and_notification_are_by_choice(server: Served, browser: Browser) -> None:
    with at_the_table(server, browser) as (tablet, run_id):
        page = tablet.page
        page.add_init_script(f"({HEARD})()")
        tablet.go(f"/runs/{run_id}")
        record(server, run_id, skip("fixation"))
        expect(page.get_by_role("heading", name="Capture", level=1)).to_be_visible(timeout=20_000)
        expect(page).to_have_title(re.compile("^Waits: Capture: your confirmation is awaited"))
        assert page.evaluate("heard") == []
        choice = page.get_by_role("button", name="Alerts")
        expect(choice).to_have_attribute("aria-pressed", "false")
        choice.click()
        expect(choice).to_have_attribute("aria-pressed", "true")
        assert page.evaluate("heard.length") > 0  # it sounds
        page.evaluate("heard.length = 0")
        failed = StepFailed(step="capture", attempt=1, error="DeviceError", message="no link", recovery="ask")
        go = OperatorAction(action="confirm", step="capture")
        record(server, run_id, go, StepStarted(step="capture", attempt=1), failed)
        expect(page.get_by_role("heading", name="Capture did not work")).to_be_visible(timeout=20_000)
        assert page.evaluate("heard") == [880, 440, 880, 440]
        assert page.evaluate("noted") == [["Stopped: Capture: No link → check the device.", f"Run {run_id}"]]
        expect(page).to_have_title(re.compile("^Stopped: Capture: No link"))
        # The choice belongs to the screen: another page of it also reports, here that the run has ended.
        tablet.go("/account")
        expect(page.get_by_role("button", name="Alerts")).to_have_attribute("aria-pressed", "true")
