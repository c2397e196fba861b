"""The guided screen in a real browser: a technician, a second tablet, a lost connection, a restarted web process."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, expect

from service.core.records.run_events import ViewpointCaptured
from service.store.store import Store
from tests.support.pages.accounts import PASSWORD, PIN, invite_people
from tests.support.pages.browser import (
    DESKTOP,
    Cable,
    Screen,
    Served,
    accept_on_page,
    accessibility_faults,
    follow,
    invite_on_page,
    screen,
    served,
    set_up_administrator,
)
from tests.support.processes.waiting import until
from tests.support.protocols.short_protocol import short_protocol
from tests.support.rig.rig import press_pedal, simulated_rig

pytestmark = [pytest.mark.timeout(400)]

LONG_MS = 60_000


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    folder = tmp_path_factory.mktemp("rig")
    with simulated_rig(folder, "--scene", "3", "--image-width", "400", "--speed-up", "3", host="127.0.0.51") as ready:
        yield ready


@pytest.fixture(scope="module")
def server(rig: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("served")
    short_protocol(folder / "protocols", views=8, release=True)
    with served(Path(rig["rig"]), folder / "data", "--protocols", str(folder / "protocols")) as running:
        yield running


@pytest.fixture(scope="module")
def people(server: Served, browser: Browser) -> None:
    """Set up the people as in practice: a one-time link for the administrator, who invites the others.

    The first of them is invited on the page.
    """
    with screen(browser, server.url) as first:
        set_up_administrator(first, server.set_up)
        link = invite_on_page(first, "tina", "technician")
        with screen(browser, server.url) as own:
            accept_on_page(own, link)
            # The link works only once.
            assert own.page.goto(link).status in (404, 409, 410)  # type: ignore[union-attr]
    invite_people(server.data, (("tom", "technician"), ("sam", "supervisor"), ("otto", "auditor")))


def start(tablet: Screen) -> str:
    """Begin a run of the short protocol; returns its id."""
    tablet.go("/")
    tablet.page.get_by_role("button", name="Start A short protocol").click()
    tablet.page.get_by_label("Specimen").fill("S1")
    tablet.page.get_by_role("button", name="Start the run").click()
    expect(tablet.page.get_by_role("heading", name="Fix the specimen and place the spheres")).to_be_visible(
        timeout=LONG_MS
    )
    expect(tablet.page.get_by_role("checkbox").first).to_be_visible(timeout=LONG_MS)
    return tablet.page.url.rpartition("/")[2]


def tick_all(page: Page) -> None:
    boxes = page.get_by_role("checkbox")
    expect(boxes.first).to_be_visible(timeout=LONG_MS)
    for i in range(boxes.count()):
        if boxes.nth(i).get_attribute("aria-checked") == "false":
            boxes.nth(i).click()
            expect(boxes.nth(i)).to_have_attribute("aria-checked", "true")


def confirm_list(page: Page) -> None:
    tick_all(page)
    page.get_by_role("button", name="Confirm: all of this is done").click()


def captured(server: Served, run: str) -> list[ViewpointCaptured]:
    """The viewpoints recorded so far."""
    with Store.open(server.data, create=False) as store:
        return [e.payload for e in store.events(run) if isinstance(e.payload, ViewpointCaptured)]


def images(page: Page, run: str) -> int:
    """The number of the run's images, as read by another page of the same browser."""
    return page.evaluate(
        """async (run) => {
            const text = await (await fetch(`/audit/runs/${run}/artefacts?kind=image`)).text();
            return new Set([...text.matchAll(/v1_[0-9]{3}/g)].map((m) => m[0])).size;
        }""",
        run,
    )


@pytest.mark.slow
def test_a_technician_is_led_through_a_run_and_a_second_person_releases_it(
    server: Served, browser: Browser, people: None
) -> None:
    with screen(browser, server.url, touch=True) as tablet:
        page = tablet.page
        tablet.sign_in("tina")
        run = start(tablet)
        confirm = page.get_by_role("button", name="Confirm: all of this is done")
        expect(confirm).to_be_disabled()
        assert accessibility_faults(page) == []
        confirm_list(page)

        # The robot moves only if the button is held long enough, by hand or by key.
        go = page.get_by_role("button", name="Confirm: the robot takes 8 images at station 1")
        expect(go).to_be_visible(timeout=LONG_MS)
        go.click()
        tablet.hold("Confirm: the robot takes 8 images", 0.8)
        page.reload()
        expect(go).to_be_enabled(timeout=LONG_MS)
        go.focus()
        page.keyboard.down("Enter")
        page.wait_for_timeout(1900)
        page.keyboard.up("Enter")
        expect(page.get_by_text("Working").first).to_be_visible(timeout=LONG_MS)

        # The pause is reported once the arm stands still.
        expect(page.get_by_text(re.compile(r"[2-7] of 8")).first).to_be_visible(timeout=LONG_MS)
        page.get_by_role("button", name="Pause").click()
        expect(page.get_by_role("heading", name="Paused. The robot stands still.")).to_be_visible(timeout=LONG_MS)
        assert accessibility_faults(page) == []

        # A viewpoint is retaken, with a reason; the earlier image stays in the record.
        tablet.go(f"/runs/{run}/capture")
        follow(page.locator("#sheet, .sheet, main").last.get_by_role("link", name=re.compile("v1_001")).last)
        page.get_by_text("Redo v1_001…").click()
        page.get_by_label("Reason").first.fill("a hand was in the picture")
        redo = page.get_by_role("button", name="Redo v1_001")
        if redo.get_attribute("data-hold"):
            tablet.hold("Redo v1_001")
        else:
            redo.click()
        expect(page.get_by_role("link", name="Show 1 replaced")).to_be_visible(timeout=LONG_MS)

        tablet.go(f"/runs/{run}")
        tablet.hold("Resume")
        expect(page.get_by_role("heading", name="Photograph the set-up")).to_be_visible(timeout=LONG_MS)
        page.get_by_role("button", name="Skip").click()
        page.locator("dialog[open]").get_by_label("Reason").fill("no second camera today")
        page.get_by_role("button", name="Skip the step").click()

        expect(page.get_by_role("heading", name="Remove the control spheres")).to_be_visible(timeout=LONG_MS)
        expect(page.get_by_role("heading", name="This cannot be undone")).to_be_visible()
        sign(page, "not the password")
        expect(page.get_by_role("alert").filter(has_text="assword").first).to_be_visible()
        page.get_by_label("Your password").fill(PASSWORD)
        page.get_by_role("button", name="Sign", exact=True).click()
        confirm_list(page)
        expect(page.get_by_role("heading", name="The run is complete")).to_be_visible(timeout=LONG_MS)

        # People who took part cannot release the run, and nothing is exported before its release.
        tablet.go(f"/runs/{run}/exports")
        expect(page.get_by_role("button", name="Sign and release")).to_have_count(0)

    with screen(browser, server.url, DESKTOP) as desk:
        page = desk.page
        desk.sign_in("sam")
        desk.go(f"/runs/{run}/exports")
        assert accessibility_faults(page) == []
        page.get_by_role("button", name="Verify now").click()
        expect(page.get_by_role("button", name="Sign and release")).to_be_visible(timeout=LONG_MS)
        page.get_by_label(re.compile("password", re.IGNORECASE)).fill(PASSWORD)
        page.get_by_role("button", name="Sign and release").click()
        expect(page.get_by_text("This run has been released.")).to_be_visible()
        page.get_by_role("button", name="Evidence bundle").click()
        expect(page.get_by_role("link", name=re.compile("SIMULATED.*zip")).first).to_be_visible(timeout=LONG_MS)

        # One altered byte: the evidence fails, and every further export with it.
        photograph = max(
            (path for path in (server.data / "artefacts").rglob("*") if path.is_file()),
            key=lambda p: p.stat().st_size,
        )
        original = photograph.read_bytes()
        photograph.chmod(0o644)
        photograph.write_bytes(original[:1000] + bytes([original[1000] ^ 1]) + original[1001:])
        desk.go(f"/runs/{run}/exports")
        page.get_by_role("button", name="Evidence bundle").click()
        expect(page.get_by_role("heading", name="Nothing was exported")).to_be_visible(timeout=LONG_MS)
        expect(page.get_by_text(photograph.name).first).to_be_visible()
        photograph.write_bytes(original)

    with screen(browser, server.url, DESKTOP) as desk:
        page = desk.page
        desk.sign_in("otto")
        desk.go(f"/audit/runs/{run}")
        for reason in ("a hand was in the picture", "no second camera today"):
            expect(page.get_by_text(reason).first).to_be_visible(timeout=LONG_MS)
        page.get_by_role("button", name="Verify now").click()
        expect(page.get_by_role("heading", name="Verifies")).to_be_visible(timeout=LONG_MS)
        desk.go(f"/runs/{run}")
        expect(page.get_by_role("button", name=re.compile("Confirm|Redo|Resume"))).to_have_count(0)


def sign(page: Page, password: str) -> None:
    page.locator(".actions").get_by_role("button", name=re.compile("^Sign")).click()
    page.get_by_label("Your password").fill(password)
    page.get_by_role("button", name="Sign", exact=True).click()


@pytest.mark.slow
@pytest.mark.sweep  # each of these alone: test_browser_forms.py, test_browser_pages.py, test_screen_runner.py
def test_two_tablets_a_lost_connection_and_a_killed_web_process_do_not_disturb_a_capture(
    server: Served, browser: Browser, rig: dict[str, Any], people: None
) -> None:
    cable = Cable(server.url)
    with (
        contextlib.closing(cable),
        screen(browser, server.url) as first,
        screen(browser, cable.url, DESKTOP, dark=True) as second,
    ):
        first.sign_in("tina")
        second.sign_in("tom")
        run = start(first)
        first.page.get_by_role("checkbox").first.click()
        second.go(f"/runs/{run}")
        expect(second.page.get_by_text("Tina Example has control")).to_be_visible()
        expect(second.page.get_by_role("button", name=re.compile("Confirm"))).to_have_count(0)

        # What one screen ticks, the other shows; a reload restores it.
        first.page.get_by_role("checkbox").nth(1).click()
        expect(second.page.get_by_text("done", exact=True)).to_have_count(2, timeout=LONG_MS)
        first.page.reload()
        expect(first.page.locator("[aria-checked=true]")).to_have_count(2)

        # Control is requested and handed over.
        second.page.get_by_role("button", name="Ask for control").click()
        first.page.get_by_role("button", name="Hand over").click()
        expect(first.page.locator("main").get_by_text("Tom Example has control")).to_be_visible(timeout=LONG_MS)
        confirm_list(second.page)

        # One tablet loses its connection: it says so and disables its controls; the other goes on.
        go = second.page.get_by_role("button", name="Confirm: the robot takes 8 images")
        expect(go).to_be_enabled(timeout=LONG_MS)
        cable.cut()
        expect(second.page.get_by_text("Connection lost")).to_be_visible(timeout=LONG_MS)
        expect(go).to_be_disabled()
        cable.plug()
        expect(second.page.get_by_text("Connection lost")).to_be_hidden(timeout=LONG_MS)
        expect(go).to_be_enabled()

        # The foot pedal acts like the button: one press arms, two move the robot.
        armed = second.page.get_by_text("Foot pedal pressed once").first
        for _ in range(20):  # a press that this machine reads too late counts for nothing
            press_pedal(rig["world"])
            with contextlib.suppress(AssertionError):
                expect(armed).to_be_visible(timeout=LONG_MS / 6)
                break
        else:
            pytest.fail("no press arms the pedal")
        working = second.page.get_by_text("Working").first
        for _ in range(20):  # a press that this machine reads too late is a first one again
            second.page.wait_for_timeout(800)  # a shorter pause would be a bounce
            press_pedal(rig["world"])
            if working.is_visible():
                break
        expect(working).to_be_visible(timeout=LONG_MS)

        # The web process is killed in the middle of the capture: the runner is not affected.
        # Read from the evidence, which is faster than a page on a busy machine.
        until(lambda: len(captured(server, run)) >= 2, server.log)
        server.kill(signal.SIGKILL)
        assert len(captured(server, run)) < 8, "the capture was over before the web process was killed"
        expect(second.page.get_by_text("Connection lost")).to_be_visible(timeout=LONG_MS)
        second.page.wait_for_timeout(3000)
        server.start()
        expect(second.page.get_by_text("Connection lost")).to_be_hidden(timeout=LONG_MS)
        expect(second.page.get_by_role("heading", name="Photograph the set-up")).to_be_visible(timeout=LONG_MS)
        assert images(second.page, run) == 8
        confirm_list(second.page)

        # The runner dies: the screen says so and what is safe, and restarts it on request.
        expect(second.page.get_by_role("heading", name="Remove the control spheres")).to_be_visible(timeout=LONG_MS)
        runner = json.loads((server.data / "monitor" / f"{run}.json").read_text())["pid"]
        os.kill(runner, signal.SIGKILL)
        expect(second.page.get_by_text("Everything captured is safe").first).to_be_visible(timeout=LONG_MS)
        second.page.get_by_role("button", name="Go on").click()
        expect(second.page.get_by_text("Everything captured is safe")).to_have_count(0, timeout=LONG_MS)

        # A screen is left with the run open: a PIN unlocks it, and the page was readable meanwhile.
        second.page.get_by_role("button", name="Lock").click()
        expect(second.page.get_by_label("PIN")).to_be_visible()
        second.page.get_by_label("PIN").fill(PIN)
        second.page.get_by_role("button", name=re.compile("Unlock")).click()
        expect(second.page.get_by_label("PIN")).to_be_hidden()

        second.page.get_by_role("button", name="End run").click()
        second.page.locator("dialog[open]").get_by_label("Reason").fill("end of the test")
        second.page.get_by_role("checkbox", name=re.compile("want to end")).check()
        second.page.get_by_role("button", name="End the run").click()
        expect(second.page.get_by_text(re.compile("aborted|ended", re.IGNORECASE)).first).to_be_visible(
            timeout=LONG_MS
        )
