"""In a real browser: the robot's state stays in sight, however far a page is scrolled; the camera's live view."""

from __future__ import annotations

import re
import threading
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, FloatRect, Locator, Page, expect

from service.core.records.run_events import OperatorAction, StepFailed, StepStarted
from service.monitor.snapshot import write_frame
from tests.support.pages.at_the_table import at_the_table, record
from tests.support.pages.browser import TABLET, Served, screen, served
from tests.support.pages.shown_site import skip
from tests.support.pages.web import WebSite, password_of, web_site
from tests.support.recorded.calibrated_run import RIG, begin_calibrated_run
from tests.support.runs.bench_run import PROTOCOL

pytestmark = [pytest.mark.timeout(300)]
AT_THE_LENS = PROTOCOL.replace("id: fixation", "id: camera_set_up\n    drawing: camera")


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


@pytest.mark.slow
def test_the_banner_stays_and_a_new_step_begins_at_its_head(server: Served, browser: Browser) -> None:
    with at_the_table(server, browser) as (tablet, run_id):
        page = tablet.page
        page.evaluate("document.querySelector('main').style.paddingBottom = '1500px'")
        page.evaluate("window.scrollTo(0, 900)")
        assert scrolled(page) > 500
        assert in_sight(page, "#robot-banner .robot-banner")
        record(server, run_id, skip("fixation"))
        title = page.get_by_role("heading", name="Capture", level=1)
        expect(title).to_be_focused()
        assert scrolled(page) == 0
        assert in_sight(page, "#robot-banner .robot-banner")
        assert in_sight(page, ".step-head h1")
        # The same for a stopped step: what happened is above what can be done about it.
        page.evaluate("window.scrollTo(0, 900)")
        page.get_by_role("button", name="Pause").focus()
        failed = StepFailed(step="capture", attempt=1, error="DeviceError", message="no link", recovery="ask")
        go = OperatorAction(action="confirm", step="capture")
        record(server, run_id, go, StepStarted(step="capture", attempt=1), failed)
        expect(page.get_by_role("heading", name="Capture did not work")).to_be_visible()
        expect(title).to_be_focused()
        assert scrolled(page) == 0


@pytest.mark.slow
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


@pytest.mark.slow
def test_sound_and_notification_are_by_choice(server: Served, browser: Browser) -> None:
    with at_the_table(server, browser) as (tablet, run_id):
        page = tablet.page
        page.add_init_script(f"({HEARD})()")
        tablet.go(f"/runs/{run_id}")
        record(server, run_id, skip("fixation"))
        expect(page.get_by_role("heading", name="Capture", level=1)).to_be_visible()
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
        expect(page.get_by_role("heading", name="Capture did not work")).to_be_visible()
        page.wait_for_function("heard.length > 0")  # the page is followed after it has changed
        assert page.evaluate("heard") == [880, 440, 880, 440]
        assert page.evaluate("noted") == [["Stopped: Capture: No link → check the device.", f"Run {run_id}"]]
        expect(page).to_have_title(re.compile("^Stopped: Capture: No link"))
        # The choice belongs to the screen: another page of it also reports, here that the run has ended.
        tablet.go("/account")
        expect(page.get_by_role("button", name="Alerts")).to_have_attribute("aria-pressed", "true")


def box(found: Locator) -> FloatRect:
    there = found.bounding_box()
    assert there is not None
    return there


# --- the live view -----------------------------------------------------------------------------------------------


@contextmanager
def camera(data: Path, run_id: str, name: str = "") -> Generator[list[cv2.typing.MatLike]]:
    """A camera whose newest frame is the last one of the list."""
    frames: list[cv2.typing.MatLike] = []
    over = threading.Event()

    def send() -> None:
        while not over.wait(0.3):
            if frames:
                write_frame(data, run_id, cv2.imencode(".jpg", frames[-1])[1].tobytes(), name)

    sender = threading.Thread(target=send)
    sender.start()
    try:
        yield frames
    finally:
        over.set()
        sender.join()


@pytest.mark.slow
def test_the_lens_is_focused_by_the_live_view_of_its_step(server: Served, browser: Browser) -> None:
    noise = np.random.default_rng(1).integers(40, 200, (85, 128), np.uint8)
    sharp = cv2.resize(noise, (1024, 680), interpolation=cv2.INTER_NEAREST)
    with (
        at_the_table(server, browser, protocol=AT_THE_LENS) as (tablet, run_id),
        camera(server.data, run_id) as frames,
    ):
        page = tablet.page
        panel = page.get_by_role("region", name="Live view")
        figure, marks = panel.locator("[data-live-figure]"), panel.locator("[data-live-marks]")
        frames.append(sharp)
        panel.get_by_role("button", name="Start live view").click()
        expect(figure).to_have_text("100 %")
        found = int(marks.get_attribute("data-found") or 0)
        assert found > 10_000, "edges are marked"
        red = page.evaluate(
            """() => { const c = document.querySelector("[data-live-marks]");
                const d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
                let n = 0;
                for (let i = 0; i < d.length; i += 4) if (d[i] === 255 && d[i + 1] === 40 && d[i + 3] === 255) n += 1;
                return n; }"""
        )
        assert red > 0.8 * found  # the magnifier's frame covers some
        frames.append(cv2.GaussianBlur(sharp, (0, 0), 6))
        expect(figure).to_have_text(re.compile(r"^[123]?\d %"))
        assert int(marks.get_attribute("data-found") or 0) < 0.5 * found
        frames.append(sharp)
        expect(figure).to_have_text(re.compile(r"^(9[5-9]|100) %"))
        panel.get_by_role("button", name="Mark sharp edges").click()
        expect(marks).to_have_attribute("data-found", "0")
        # The magnifier shows the touched area, in pixels of the frame.
        frames.append(np.where(np.arange(1024) < 512, 30, 220).astype(np.uint8)[None].repeat(680, 0))
        expect(panel.locator("[data-live-light]")).to_contain_text("Mean 125 of 255; 0.0 % at the white end")
        stage = box(panel.locator("[data-live-stage]"))
        for share, light in ((0.2, 30), (0.8, 220)):
            page.mouse.click(stage["x"] + share * stage["width"], stage["y"] + 0.5 * stage["height"])
            middle = """() => {
                const loupe = document.querySelector("[data-live-loupe]").getContext("2d");
                return [...loupe.getImageData(160, 120, 1, 1).data];
            }"""
            assert page.evaluate(middle)[0] == pytest.approx(light, abs=3)
        frames.append(np.full((680, 1024), 255, np.uint8))
        expect(panel.locator("[data-live-light]")).to_contain_text("100.0 % at the white end")
        # The event belongs to this step.
        step = OperatorAction(action="skip", step="camera_set_up", reason="focused the day before")
        record(server, run_id, step)
        expect(panel).to_be_hidden()


FURTHER = (
    "cameras:\n  side: {mounted: fixed, calibration: side.json}\n  top: {mounted: fixed, calibration: top.json}\n"
)
# The network brings the first camera's frames when the test lets it; `shown` has what the page says meanwhile.
SLOW_FIRST_CAMERA = """() => {
    const real = window.fetch, view = document.querySelector("[data-live-view]");
    window.held = [];
    window.shown = [];
    let tell;
    window.asked = new Promise((go) => { tell = go; });
    window.fetch = async (address, options) => {
        const answer = await real(address, options);
        if (address.endsWith("camera=")) {
            await new Promise((go) => { window.held.push(go); tell(); });
            const look = () => { if (!view.classList.contains("without-frame")) window.shown.push("frame"); };
            new MutationObserver(look).observe(view, { attributes: true });
        }
        return answer;
    };
}"""
LIGHTS = {"": 60, "side": 120, "top": 180}


def run_with_three_cameras(web: WebSite) -> str:
    device = "{driver: gphoto, port: usb}"
    rig = RIG.replace("devices: {", f"{FURTHER}devices: {{side: {device}, top: {device}, ", 1)
    return begin_calibrated_run(web, rig_text=rig)


@pytest.mark.slow
def test_the_live_view_changes_to_the_camera_that_is_pressed(server: Served, browser: Browser) -> None:
    with web_site(server.data.parent) as web:
        run_id = run_with_three_cameras(web)
    with (
        ExitStack() as cameras,
        screen(browser, server.url, TABLET) as tablet,
    ):
        for name, light in LIGHTS.items():
            frames = cameras.enter_context(camera(server.data, run_id, name))
            frames.append(np.full((340, 512), light, np.uint8))
        tablet.sign_in("grace", password_of("grace"))
        tablet.go(f"/runs/{run_id}/capture")
        page = tablet.page
        panel = page.get_by_role("region", name="Live view")
        light, choice = panel.locator("[data-live-light]"), panel.get_by_role("group", name="Camera of the live view")
        panel.get_by_role("button", name="Start live view").click()
        expect(light).to_contain_text("Mean 60 of 255")
        for name in ("side", "top", ""):
            button = choice.get_by_role("button", name=name or "First camera")
            button.click()
            expect(button).to_have_attribute("aria-pressed", "true")
            expect(choice.locator("[aria-pressed=true]")).to_have_count(1)
            expect(light).to_contain_text(f"Mean {LIGHTS[name]} of 255")
            expect(panel.get_by_role("status")).to_have_text("Live")


@pytest.mark.slow
def test_a_frame_of_the_camera_that_was_left_is_not_shown_as_the_other_ones(server: Served, browser: Browser) -> None:
    with web_site(server.data.parent) as web:
        run_id = run_with_three_cameras(web)
    with camera(server.data, run_id) as frames, screen(browser, server.url, TABLET) as tablet:
        frames.append(np.full((340, 512), 60, np.uint8))
        tablet.sign_in("grace", password_of("grace"))
        tablet.go(f"/runs/{run_id}/capture")
        page = tablet.page
        panel = page.get_by_role("region", name="Live view")
        panel.get_by_role("button", name="Start live view").click()
        expect(panel.get_by_role("status")).to_have_text("Live")
        page.evaluate(SLOW_FIRST_CAMERA)
        page.evaluate("asked")
        panel.get_by_role("button", name="top", exact=True).click()  # it sends no frames
        expect(panel.locator("[data-live-light]")).to_have_text("")
        page.evaluate("held.forEach((go) => go())")
        expect(panel.get_by_role("status")).to_have_text(re.compile("^No frame yet"))
        assert page.evaluate("shown") == []
