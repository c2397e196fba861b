"""A technician at a tablet fills in the start form, takes a note with a photograph, and finds the run again."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, expect

from service.core.records.entered import NoteTaken
from service.core.records.run_events import RunStarted
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.pages.accounts import add_people
from tests.support.pages.browser import screen, served
from tests.support.runs.bench_run import PROTOCOL

pytestmark = [pytest.mark.timeout(300)]


@pytest.mark.slow
def test_a_run_is_started_noted_on_and_found(tmp_path: Path, browser: Browser) -> None:
    (tmp_path / "rig.yaml").write_text("name: bench\nsimulated: true\ndevices: {}\n")
    protocols = tmp_path / "protocols"
    protocols.mkdir()
    (protocols / "bench.yaml").write_text(PROTOCOL)
    data = tmp_path / "data"
    Store.open(data).close()
    add_people(data, [("tina", "technician")])
    picture = cv2.imencode(".jpg", np.full((600, 800, 3), 120, np.uint8))[1].tobytes()
    with (
        served(tmp_path / "rig.yaml", data, "--protocols", str(protocols)) as server,
        screen(browser, server.url) as tablet,
    ):
        page = tablet.page
        tablet.sign_in("tina")
        tablet.go("/")
        page.get_by_role("button", name="Start A small procedure").click()
        page.get_by_label("Specimen").fill("Spine 7")
        page.get_by_label("Purpose").fill("Pilot")
        expect(page.get_by_label("Operator")).to_have_value("Tina Example")
        page.get_by_role("button", name="Start the run").click()
        expect(page.get_by_role("heading", name="Fix the specimen")).to_be_visible(timeout=60_000)
        expect(page.get_by_text("Spine 7", exact=True)).to_be_visible()
        page.get_by_role("button", name="Note…").click()
        camera = page.get_by_label("Photograph")
        expect(camera).to_have_attribute("capture", "environment")
        page.get_by_role("button", name="Record the note").click()
        expect(page.get_by_text("The note is empty")).to_be_visible(timeout=60_000)
        page.get_by_label("Text").fill("A wire has slipped")
        camera.set_input_files({"name": "tablet.jpg", "mimeType": "image/jpeg", "buffer": picture})
        page.get_by_role("button", name="Record the note").click()
        expect(page.get_by_role("dialog")).to_have_count(0, timeout=60_000)
        noted = page.locator(".note-list li")
        expect(noted).to_have_count(1, timeout=60_000)
        expect(noted).to_contain_text("A wire has slipped")
        expect(noted.get_by_role("img")).to_have_js_property("complete", value=True, timeout=60_000)
        assert noted.get_by_role("img").evaluate("image => image.naturalWidth") == 320
        run_id = page.url.rpartition("/")[2]
        tablet.go("/?q=slipped")
        expect(page.get_by_role("link", name=f"Open run {run_id}")).to_be_visible()
        tablet.go("/?q=fractured")
        expect(page.get_by_text("0 runs match.")).to_be_visible()
    with Store.open(data) as store:
        events = store.events(run_id)
    root = events[0].payload
    assert isinstance(root, RunStarted)
    assert root.about is not None
    assert (root.about.specimen, root.about.purpose, root.about.operator) == ("Spine 7", "Pilot", "Tina Example")
    (note,) = (event for event in events if isinstance(event.payload, NoteTaken))
    assert note.actor == "tina"
    assert verify(data, run_id).ok
