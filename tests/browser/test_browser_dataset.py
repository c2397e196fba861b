"""The page of a data set in a real browser: accessible, usable by touch and by keys, the slider moves the depth."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from service.store.store import Store
from tests.support.pages.accounts import add_people
from tests.support.pages.browser import (
    DESKTOP,
    TABLET,
    Screen,
    accessibility_faults,
    follow,
    screen,
    scripts_held_back,
    served,
)
from tests.support.recorded.unpacked_run import unpack_recorded_run

pytestmark = [pytest.mark.timeout(300)]

CHECKS = (Path(__file__).parents[1] / "support" / "pages" / "page_checks.js").read_text()


@pytest.fixture(scope="module")
def tablet(tmp_path_factory: pytest.TempPathFactory, browser: Browser) -> Iterator[Screen]:
    """A supervisor's tablet, on which the page of the recorded run's data set is complete."""
    folder = tmp_path_factory.mktemp("dataset")
    data = unpack_recorded_run(folder)
    rig = folder / "rig.yaml"
    rig.write_text("name: bench\nsimulated: true\ndevices: {}\n")
    add_people(data, (("sam", "supervisor"),))
    with Store.open(data) as store:
        run = store.runs()[0].run_id
    with served(rig, data) as server, screen(browser, server.url, touch=True) as shown:
        shown.sign_in("sam")
        shown.go(f"/runs/{run}/dataset")
        expect(shown.page.locator("[data-pending]")).to_have_count(0, timeout=200_000)
        shown.go(f"/runs/{run}/dataset")
        yield shown


def opacity(page: Page) -> float:
    return float(page.locator("#depth-over").evaluate("e => getComputedStyle(e).opacity"))


@pytest.mark.slow
def test_the_whole_page_is_accessible_and_its_targets_are_large(tablet: Screen) -> None:
    page = tablet.page
    page.evaluate(CHECKS)
    assert accessibility_faults(page) == []
    assert page.evaluate("check.small()") == []
    for width in (768, 1024, 1920, 3840):
        page.set_viewport_size({"width": width, "height": DESKTOP[1]})
        assert page.evaluate("check.sideways()") == [], width
    page.emulate_media(color_scheme="dark")
    assert accessibility_faults(page) == []
    page.emulate_media(color_scheme="light")
    page.set_viewport_size({"width": TABLET[0], "height": TABLET[1]})


@pytest.mark.slow
def test_the_slider_is_moved_by_a_finger_and_by_keys(tablet: Screen) -> None:
    page = tablet.page
    slider = page.get_by_label("From photograph to depth")
    slider.scroll_into_view_if_needed()
    box = slider.bounding_box()
    assert box is not None
    assert box["height"] >= 44
    middle = box["y"] + box["height"] / 2
    page.touchscreen.tap(box["x"] + box["width"] - 4, middle)
    assert opacity(page) == 1
    page.touchscreen.tap(box["x"] + 4, middle)
    assert opacity(page) == 0
    slider.focus()
    page.keyboard.press("End")
    assert opacity(page) == 1
    for _ in range(30):
        page.keyboard.press("ArrowLeft")
    assert opacity(page) == pytest.approx(0.7)


@pytest.mark.slow
def test_photograph_and_depth_cover_each_other(tablet: Screen) -> None:
    boxes = [image.bounding_box() for image in tablet.page.locator(".depth-stack img").all()]
    assert len(boxes) == 2
    assert boxes[0] == boxes[1]
    loaded = "images => images.every(image => image.complete && image.naturalWidth > 0)"
    assert tablet.page.locator(".depth-stack img").evaluate_all(loaded)


@pytest.mark.slow
def test_another_view_and_another_split_are_chosen(tablet: Screen) -> None:
    page = tablet.page
    follow(page.locator(".splits").get_by_role("link", name="Sparse"))
    expect(page.locator(".splits [aria-current]")).to_contain_text("Sparse")
    names = page.locator(".view-name").all_inner_texts()
    page.locator("select[name=view]").select_option(names[-1])
    expect(page.get_by_alt_text(f"Photograph of view {names[-1]}")).to_be_visible()
    expect(page.locator(".splits [aria-current]")).to_contain_text("Sparse")
    follow(page.get_by_role("link", name="Previous view"))
    expect(page.get_by_alt_text(f"Photograph of view {names[-2]}")).to_be_visible()
    follow(page.locator(".view-link").first)
    expect(page.get_by_alt_text(f"Photograph of view {names[0]}")).to_be_visible()
    with scripts_held_back(page) as come:
        page.reload(wait_until="commit")
        page.locator("select[name=view]").select_option(names[-1])
        come()
    expect(page.get_by_alt_text(f"Photograph of view {names[-1]}")).to_be_visible()


@pytest.mark.slow
def test_a_format_is_exported_with_its_progress_shown(tablet: Screen) -> None:
    page = tablet.page
    follow(page.get_by_role("link", name="Export…"))
    page.get_by_label("Format").select_option("nerfstudio", timeout=60_000)
    page.get_by_role("button", name="Export in this format").click()
    expect(page.get_by_text("exports since").or_(page.get_by_text("Ready:"))).to_be_visible()
    link = page.locator("#exporting").get_by_role("link")
    expect(link).to_be_visible(timeout=200_000)
    with page.expect_download() as download:
        link.click()
    assert download.value.suggested_filename.endswith("nerfstudio-SIMULATED.zip")
    assert accessibility_faults(page) == []
