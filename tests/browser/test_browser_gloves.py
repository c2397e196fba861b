"""Gloved hands and badge readers in a real browser: the plan, a badge, the keyboard."""

from __future__ import annotations

import re
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, FloatRect, Locator, Page, expect

from service.core.protocol import parse_protocol
from service.core.records.run_events import OperatorAction, StepNote
from service.rig import load_rig
from service.run_start import start_run
from service.steps import params_models
from service.store.store import Store
from tests.support.pages.at_the_table import STANDING, at_the_table, left_at, record
from tests.support.pages.browser import TABLET, Screen, Served, follow, screen, served
from tests.support.pages.shown_site import skip
from tests.support.pages.web import password_of, web_site
from tests.support.recorded.calibrated_run import RIG
from tests.support.runs.attended import attended
from tests.support.runs.bench_run import PROTOCOL

pytestmark = [pytest.mark.timeout(300)]
BADGE = "0004711815"
DENSE = PROTOCOL.replace("count: 4", "count: 54")  # as many viewpoints as a station of the paper's protocol
# A badge reader's keys: far faster than the test could press them; the letters end in the focused field.
READ = """(badge) => {
    for (const key of badge) {
        const field = document.activeElement;
        const down = new KeyboardEvent("keydown", { key, bubbles: true, cancelable: true });
        if (field.dispatchEvent(down) && "value" in field) field.value += key;
    }
    const enter = new KeyboardEvent("keydown", { key: "Enter", bubbles: true, cancelable: true });
    document.activeElement.dispatchEvent(enter);
}"""


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("gloves")
    with web_site(folder) as web:
        web.people.badges.enrol(web.browser("supervisor").person, "grace", password_of("grace"), BADGE)
    (folder / "rig.yaml").write_text("name: bench\nsimulated: true\ndevices: {}\nsigning: {pin: true, badge: true}\n")
    with served(folder / "rig.yaml", folder / "data", "--protocols", str(folder / "protocols")) as running:
        yield running


def box(found: Locator) -> FloatRect:
    there = found.bounding_box()
    assert there is not None
    return there


# --- the plan ----------------------------------------------------------------------------------------------------


def dense_run(data: Path) -> str:
    """A run that nobody drives, whose plan has 54 viewpoints on one arc."""
    rig = data.parent / "stations.yaml"
    rig.write_text(RIG)
    loaded = parse_protocol(DENSE.encode(), params_models(), name="dense.yaml")
    with Store.open(data) as store:
        return start_run(store, loaded, load_rig(rig), operator="grace", auto_confirm=False)


def where(page: Page, viewpoint: str) -> tuple[float, float]:
    """The centre of a viewpoint's symbol on the screen."""
    x, y = page.evaluate(
        """(name) => {
            const group = document.querySelector(`g[data-viewpoint="${name}"]`);
            const { x, y } = group.dataset;
            const at = new DOMPoint(Number(x), Number(y)).matrixTransform(group.ownerSVGElement.getScreenCTM());
            return [at.x, at.y];
        }""",
        viewpoint,
    )
    return x, y


def apart_px(page: Page) -> float:
    """The distance between two neighbours on the screen."""
    (x, y), (to_x, to_y) = where(page, "v027"), where(page, "v028")
    return float(np.hypot(to_x - x, to_y - y))


@contextmanager
def at_the_plan(server: Served, browser: Browser) -> Generator[tuple[Screen, str]]:
    run_id = dense_run(server.data)
    with screen(browser, server.url, TABLET, touch=True) as tablet:
        tablet.sign_in("grace", password_of("grace"))
        tablet.go(f"/runs/{run_id}/capture")
        tablet.page.locator("svg.plan").scroll_into_view_if_needed()
        yield tablet, run_id


@pytest.mark.slow
def test_viewpoints_closer_than_a_fingertip_are_chosen_from_a_list(server: Served, browser: Browser) -> None:
    with at_the_plan(server, browser) as (tablet, _run_id):
        page = tablet.page
        assert apart_px(page) < 6
        page.touchscreen.tap(*where(page, "v027"))
        choice = page.get_by_role("dialog", name="Which of these")
        expect(choice).to_be_visible()
        names = [text.split()[0] for text in choice.locator("li").all_inner_texts()]
        assert names[0] == "v027", "the nearest first"
        assert {"v026", "v028"} <= set(names)
        assert all(box(link)["height"] >= 48 for link in choice.locator("a").all())
        follow(choice.get_by_role("link", name="v028"))
        expect(page).to_have_url(re.compile("viewpoint=v028"))
        expect(page.get_by_role("heading", name="v028")).to_be_visible()


@pytest.mark.slow
def test_the_plan_is_made_larger_until_a_finger_is_enough(server: Served, browser: Browser) -> None:
    with at_the_plan(server, browser) as (tablet, run_id):
        page = tablet.page
        page.evaluate(
            "document.addEventListener('part-changed', () => { document.documentElement.dataset.changed = ''; })"
        )
        near, larger, word = (
            apart_px(page),
            page.get_by_role("button", name="Larger"),
            page.locator("[data-zoom-word]"),
        )
        assert min(box(larger)["width"], box(larger)["height"]) >= 48
        for _ in range(6):
            larger.click()
        expect(word).to_have_text("16.0×")
        expect(larger).to_be_disabled()
        assert apart_px(page) == pytest.approx(16 * near, rel=0.01)
        # A run update does not remove it.
        record(server, run_id, StepNote(step="capture", attempt=1, note="looked at", data={}))
        expect(page.locator("html[data-changed]")).to_be_attached()
        assert apart_px(page) == pytest.approx(16 * near, rel=0.01)
        page.get_by_role("button", name="The whole plan").click()
        assert apart_px(page) == pytest.approx(near, rel=0.01)

        # With the wheel, the point under the pointer stays in place.
        at = where(page, "v027")
        page.mouse.move(*at)
        for _ in range(8):
            page.mouse.wheel(0, -100)
        expect(word).to_have_text(re.compile(r"^1\d\.\d×"))
        assert where(page, "v027") == pytest.approx(at, abs=16)  # the pointer is on whole pixels, magnified
        scrolled = page.evaluate("scrollY")
        page.get_by_role("button", name="The whole plan").click()

        # Pinch with two fingers.
        devtools = page.context.new_cdp_session(page)
        x, y = where(page, "v027")
        for kind, reach in (("touchStart", 20), ("touchMove", 60), ("touchMove", 200), ("touchEnd", 0)):
            points = [{"x": x - reach, "y": y}, {"x": x + reach, "y": y}] if reach else []
            devtools.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        expect(word).to_have_text(re.compile(r"^([89]|1\d)\.\d×"))
        assert page.evaluate("[scrollY, visualViewport.scale]") == [scrolled, 1], "the page itself stays"
        assert apart_px(page) > 24
        # A finger now touches only one symbol.
        page.touchscreen.tap(*where(page, "v027"))
        expect(page).to_have_url(re.compile("viewpoint=v027"))
        expect(word).not_to_have_text("1.0×")  # and the next one is just as close


# --- a badge -----------------------------------------------------------------------------------------------------


@contextmanager
def at_the_signature(server: Served, browser: Browser) -> Generator[tuple[Screen, str]]:
    with web_site(server.data.parent) as web:
        run_id = left_at(web, "spraying", "sign").run_id
    with attended(server.data, {run_id: STANDING}), screen(browser, server.url) as tablet:
        tablet.sign_in("grace", password_of("grace"))
        tablet.go(f"/runs/{run_id}")
        tablet.page.get_by_role("button", name="Take control").click()
        tablet.page.get_by_role("button", name="Sign: spray").click()
        expect(tablet.page.get_by_role("dialog", name="Sign: Spray")).to_be_visible()
        yield tablet, run_id


def signed_by(server: Served, run_id: str) -> list[str]:
    with Store.open(server.data) as store:
        actions = [event.payload for event in store.events(run_id) if isinstance(event.payload, OperatorAction)]
    return [action.identified for action in actions if action.action == "sign"]


@pytest.mark.slow
def test_a_badge_held_to_the_reader_signs_and_leaves_nothing_in_the_fields(server: Served, browser: Browser) -> None:
    with at_the_signature(server, browser) as (tablet, run_id):
        page = tablet.page
        meaning = page.get_by_label("Meaning")
        meaning.focus()
        page.keyboard.press("Control+End")
        words = meaning.input_value()
        # A person's typing is not a badge: it is slower, and Enter in a text is a new line.
        page.keyboard.type("123456", delay=150)
        page.keyboard.press("Enter")
        assert meaning.input_value() == f"{words}123456\n"
        meaning.fill(words)
        page.evaluate(READ, "0004711816")  # somebody else's badge
        expect(page.get_by_text("Name and badge do not belong together")).to_be_visible()
        assert signed_by(server, run_id) == []
        assert meaning.input_value() == words
        meaning.focus()
        page.evaluate(READ, BADGE)
        expect(page.get_by_role("dialog", name="Sign: Spray")).to_be_hidden()
        assert signed_by(server, run_id) == ["badge"]


@pytest.mark.slow
def test_a_pin_is_typed_on_the_screen(server: Served, browser: Browser) -> None:
    with at_the_signature(server, browser) as (tablet, run_id):
        page = tablet.page
        dialog = page.get_by_role("dialog", name="Sign: Spray")
        expect(dialog.get_by_label("Your password")).to_be_visible()
        dialog.get_by_text("PIN", exact=True).click()
        expect(dialog.get_by_label("Your PIN")).to_be_visible()
        for digit in "2468":  # all of them are visible above the foot of the dialog
            key = dialog.get_by_role("button", name=digit, exact=True)
            assert min(box(key)["width"], box(key)["height"]) >= 48
            key.click()
        dialog.get_by_role("button", name="Sign", exact=True).click()
        expect(dialog).to_be_hidden()
        assert signed_by(server, run_id) == ["pin"]


@pytest.mark.slow
def test_a_reason_is_chosen_or_written(server: Served, browser: Browser) -> None:
    with at_the_table(server, browser) as (tablet, run_id):
        page = tablet.page
        page.get_by_role("button", name="Skip").click()
        dialog = page.get_by_role("dialog", name="Skip this step")
        assert all(box(row)["height"] >= 48 for row in dialog.locator(".presets label").all())
        dialog.get_by_text("Something else, in my own words").click()
        dialog.get_by_role("button", name="Skip the step").click()
        expect(dialog).to_be_visible()  # the reason is missing
        dialog.get_by_text("A device is out of order").click()
        dialog.get_by_label("Reason").fill("the drill")
        dialog.get_by_role("button", name="Skip the step").click()
        expect(dialog).to_be_hidden()
        with Store.open(server.data) as store:
            said = [e.payload.reason for e in store.events(run_id) if isinstance(e.payload, OperatorAction)]
        assert said == ["A device is out of order: the drill"]


# --- the keyboard ------------------------------------------------------------------------------------------------


def press(page: Page, key: str) -> None:
    """Press a key as a person does, who types slower than a badge reader."""
    page.wait_for_timeout(150)
    page.keyboard.press(key)


@pytest.mark.slow
def test_shortcuts_lead_to_everything_and_move_nothing(server: Served, browser: Browser) -> None:
    with at_the_table(server, browser) as (tablet, run_id):
        page = tablet.page
        page.locator("main").focus()
        press(page, "?")
        help_ = page.get_by_role("dialog", name="Keyboard shortcuts")
        expect(help_).to_be_visible()
        press(page, "Escape")
        expect(help_).to_be_hidden()
        press(page, "n")
        first = page.get_by_role("checkbox", name="wires hold")
        expect(first).to_be_focused()
        press(page, "Space")
        expect(first).to_be_checked()
        end = page.get_by_role("dialog", name="End this run here")
        press(page, "e")
        expect(end).to_be_visible()
        end.get_by_label("Reason").press_sequentially("p e ?")  # words are words
        assert end.get_by_label("Reason").input_value() == "p e ?"
        press(page, "Escape")
        expect(end).to_be_hidden()
        # Automatic typing does not release the shutter.
        page.evaluate(READ, "e001e")
        page.wait_for_timeout(400)
        expect(end).to_be_hidden()
        record(server, run_id, skip("fixation"))
        expect(page.get_by_role("heading", name="Capture", level=1)).to_be_focused()
        press(page, "m")
        expect(page.locator(".main-action button")).to_be_focused()
        press(page, "g")
        page.wait_for_timeout(200)
        press(page, "c")
        expect(page).to_have_url(re.compile("/capture$"))
        page.get_by_role("button", name="Keyboard shortcuts").click()
        help_.get_by_label("Shortcuts on this screen").uncheck()
        press(page, "Escape")
        press(page, "?")
        page.wait_for_timeout(400)
        expect(help_).to_be_hidden()
    with Store.open(server.data) as store:
        acts = [e.payload.action for e in store.events(run_id) if isinstance(e.payload, OperatorAction)]
    assert acts == ["skip"]
