"""The report in a browser: the scene can be turned, and on paper its drawing replaces it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from service.audit.recorded_run import read_run
from service.audit.report import report_content
from service.audit.report_output import write_html
from service.store.verification.verify import verify
from tests.support.recorded.reported_run import record_reported_run


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory, browser: Browser) -> Iterator[Page]:
    """The report of a registered run, from a file and without network."""
    folder = tmp_path_factory.mktemp("report")
    record_reported_run(folder, registered=True)
    run = read_run(folder / "data", "latest")
    path = Path(folder, "report.html")
    write_html(report_content(run, verify(folder / "data", run.run_id)), path)
    shown = browser.new_page(viewport={"width": 1280, "height": 900})
    complaints: list[str] = []
    shown.on("pageerror", lambda error: complaints.append(str(error)))
    shown.on("request", lambda asked: complaints.append(asked.url) if asked.url.startswith("http") else None)
    shown.goto(path.as_uri())
    yield shown
    shown.close()
    assert not complaints, complaints


def test_the_scene_is_turned_by_pointer_and_keys(page: Page) -> None:
    scene = page.locator(".turned")
    expect(scene).to_be_visible()
    expect(page.locator(".turned-hint")).to_be_visible()
    expect(scene.locator("span").filter(has_text="100 mm")).to_be_visible()
    scene.scroll_into_view_if_needed()
    canvas = scene.locator("canvas")
    page.wait_for_timeout(300)
    before = canvas.screenshot()
    box = scene.bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 300, box["y"] + 200)
    page.mouse.down()
    page.mouse.move(box["x"] + 420, box["y"] + 240, steps=4)
    page.mouse.up()
    page.wait_for_timeout(300)
    turned = canvas.screenshot()
    assert turned != before
    scene.focus()
    for _ in range(3):
        page.keyboard.press("ArrowLeft")
    page.keyboard.press("+")
    page.wait_for_timeout(300)
    assert canvas.screenshot() != turned


def test_the_legend_stays_in_sight_and_paper_has_the_drawing(page: Page) -> None:
    drawing, scene = page.locator(".scene-drawing svg"), page.locator(".turned")
    legend = drawing.locator("text").filter(has_text="registration spheres")
    at, covered = legend.bounding_box(), scene.bounding_box()
    assert at is not None
    assert covered is not None
    assert covered["y"] + covered["height"] <= at["y"] + 1
    page.emulate_media(media="print")
    expect(scene).to_be_hidden()
    expect(drawing).to_be_visible()
    page.emulate_media(media="screen")


def test_the_contents_lead_there(page: Page) -> None:
    page.locator(".contents a").filter(has_text="Verification").click()
    expect(page.get_by_role("heading", name="Verification", exact=False).first).to_be_in_viewport()
