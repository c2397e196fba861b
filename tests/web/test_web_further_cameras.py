"""Pages of a run with further cameras: every image with its verdicts, before anything has been computed."""

from __future__ import annotations

import re
from collections.abc import Generator
from pathlib import Path

import pytest

from service.monitor.snapshot import frames_wanted, write_frame
from tests.support.pages.browsed_run import BrowsedRun, words
from tests.support.pages.web import web_site
from tests.support.record.core import EYE
from tests.support.recorded.calibrated_run import RIG, begin_calibrated_run, capture

CAMERAS = (
    "cameras:\n  side: {mounted: fixed, calibration: side.json}\n  top: {mounted: fixed, calibration: top.json}\n"
)


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Generator[BrowsedRun]:
    """A run with three viewpoints, at one of which `side` did not expose."""
    with web_site(tmp_path_factory.mktemp("further")) as site:
        run = begin_calibrated_run(site)
        capture(site, run, "capture", "v1_001", EYE, shade=1, further={"side": True, "top": True})
        capture(site, run, "capture", "v1_002", EYE, shade=2, further={"side": False, "top": True})
        capture(site, run, "capture", "v1_003", EYE, shade=3, further={"top": True})
        yield BrowsedRun(site, site.browser("technician"), run)


def test_each_camera_at_a_viewpoint_is_shown_with_its_image_and_what_is_wrong(shown: BrowsedRun) -> None:
    html = shown.html(viewpoint="v1_002")
    strip = html[html.index('<ul class="cameras">') :]
    strip = words(strip[: strip.index("</ul>")])
    assert re.search(
        r"First camera on the arm Not all judged side in the room Settings: differ top in the room", strip
    )
    assert html.count("thumbnail=320") == 3


def test_a_further_camera_can_be_chosen_and_has_its_own_verdicts(shown: BrowsedRun) -> None:
    html = shown.html(viewpoint="v1_002", device="side")
    assert "device=side" in html[html.index('<figure class="photograph">') : html.index("</figure>")]
    said = words(html)
    assert "This image, side" in said
    assert "Differ" in said
    assert "ISO 400" in said
    assert "Pose" not in said[said.index("This image, side") : said.index("SHA-256")]


def test_a_camera_that_took_no_image_there_is_said_to(shown: BrowsedRun) -> None:
    assert "side took no image at this viewpoint" in words(shown.html(viewpoint="v1_003", device="side"))
    assert shown.browser.get(f"/runs/{shown.run}/images/v1_003?device=side").status_code == 404
    assert shown.browser.get(f"/runs/{shown.run}/images/v1_003?device=top").status_code == 200


def test_the_contact_sheet_is_that_of_the_chosen_camera(shown: BrowsedRun) -> None:
    of = {name: shown.html(device=name).split('id="sheet"')[1] for name in ("", "side", "top")}
    assert {name: html.count("thumbnail=160") for name, html in of.items()} == {"": 3, "side": 2, "top": 3}
    first = of["side"][of["side"].index('<ul class="sheet">') :]
    assert re.search(r"v1_002 Departs .*v1_001 Kept", words(first)), "what is wrong comes first"


def test_its_image_is_another_than_the_first_cameras(shown: BrowsedRun) -> None:
    pictures = {shown.browser.get(f"/runs/{shown.run}/images/v1_001?device={name}").content for name in ("", "side")}
    assert len(pictures) == 2


def test_auditors_see_calibration_and_files_before_the_registration(shown: BrowsedRun) -> None:
    said = words(shown.site.browser("auditor").get(f"/audit/runs/{shown.run}/devices").text)
    for text in ("Further cameras", "side, in the room", "RF 35mm", "side.json", "Not registered yet"):
        assert text in said, text
    files = words(shown.site.browser("auditor").get(f"/audit/runs/{shown.run}/artefacts?device=side").text)
    assert "further image" in files
    assert "camera calibration" in files


def test_the_live_view_is_that_of_the_camera_asked_for(tmp_path: Path) -> None:
    with web_site(tmp_path) as site:
        device = "{driver: gphoto, port: usb}"
        rig = RIG.replace("devices: {", f"{CAMERAS}devices: {{side: {device}, top: {device}, ", 1)
        run = begin_calibrated_run(site, rig_text=rig)
        browser, data = site.browser("technician"), site.site.data
        assert 'data-live-camera="side"' in browser.get(f"/runs/{run}/capture").text
        assert browser.get(f"/runs/{run}/live-view?camera=side").status_code == 204
        assert frames_wanted(data, run, site.now_utc_s) == "side"
        write_frame(data, run, b"\xff\xd8first")
        write_frame(data, run, b"\xff\xd8side", "side")
        assert browser.get(f"/runs/{run}/live-view?camera=side").content == b"\xff\xd8side"
        assert browser.get(f"/runs/{run}/live-view").content == b"\xff\xd8first"
        assert browser.get(f"/runs/{run}/live-view?camera=../x").status_code == 404
