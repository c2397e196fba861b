"""A rejected board image is shown as such everywhere, with a plain reason, and problems come first."""

from __future__ import annotations

import copy
import dataclasses
import re
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest

from service.core.protocol import parse_protocol
from service.core.records.run_events import StepStarted
from service.rig import load_rig
from service.run_start import start_run
from service.steps import params_models
from service.store.records import NewJob
from service.web.calibration import calibration_of, image_rows
from service.web.images import board_use, board_uses
from tests.support.pages.browsed_run import words
from tests.support.pages.web import WebSite, web_site
from tests.support.record.core import EYE
from tests.support.record.store import enqueue
from tests.support.recorded.calibrated_run import PROTOCOL, RIG, begin_calibrated_run, capture

REASON = "no board of 16 × 23 inner corners in the image (searched at widths [1200, 1920])"


@pytest.fixture
def web(tmp_path: Path) -> Generator[WebSite]:
    with web_site(tmp_path) as site:
        yield site


def begin(web: WebSite) -> str:
    rig = web.folder / "small.yaml"
    rig.write_text(RIG)
    loaded = parse_protocol(PROTOCOL.encode(), params_models(), name="calibrated.yaml")
    run_id = start_run(web.store, loaded, load_rig(rig), operator="grace", auto_confirm=False)
    web.store.record(run_id, [StepStarted(step="calibration", attempt=1)], actor="runner")
    return run_id


def look(web: WebSite, run_id: str, name: str, shade: int, **result: Any) -> str:
    """Record a board image and the worker's findings in it; returns the image's hash."""
    sha256 = capture(web, run_id, "calibration", name, EYE, kind="board_image", shade=shade)
    arguments = {"image": {"viewpoint": name, "sha256": sha256}}
    enqueue(web.store, run_id, NewJob("board_view", "calibration", 1, name, arguments), actor="runner")
    job = web.store.claim_job("worker", 60)
    assert job is not None
    seen = {"viewpoint": name, "size": [900, 600], **result}
    web.store.finish_job(job, measures={}, duration_s=0.1, result=seen)
    return sha256


def test_an_image_without_a_board_is_told_as_it_arrives(web: WebSite) -> None:
    run_id = begin(web)
    look(web, run_id, "b001", 1, seen=False, reason=REASON)
    look(web, run_id, "b002", 2, seen=True, reason="")
    waiting = capture(web, run_id, "calibration", "b003", EYE, kind="board_image", shade=3)
    browser = web.browser("technician")
    page = words(browser.get(f"/runs/{run_id}/capture?step=calibration").text)
    assert "searched at" not in page
    assert "3 of 10, 1 not used" in page.replace(" ,", ",")
    sheet = page[page.index("Contact sheet") :]
    assert "Not used no board of 16 × 23 inner corners in the image" in sheet
    assert "Kept" not in sheet
    assert sheet.index("b001") < sheet.index("b003") < sheet.index("b002")  # problems first, then the newest
    one = words(browser.get(f"/runs/{run_id}/capture?step=calibration&viewpoint=b001").text)
    assert "Board Not used no board of 16 × 23 inner corners in the image" in one
    assert "1 not used" in words(browser.get(f"/runs/{run_id}").text)
    log = web.site.run(run_id)
    assert board_uses(log.state, log.events, "calibration")[waiting].used is None


def test_the_calibration_page_shows_first_what_it_does_without(web: WebSite) -> None:
    run_id = begin_calibrated_run(web)
    page = web.browser("technician").get(f"/runs/{run_id}/calibration").text
    table = page[page.index('aria-label="Images of the calibration"') :]
    said = words(table)
    log = web.site.run(run_id)
    uses = board_uses(log.state, log.events, "calibration").values()
    assert said.count("Not used") == sum(use.used is False for use in uses)
    assert len(re.findall(r'class="board-thumb" src="/runs/[^"]+\?thumbnail=160"', table)) == len(uses)
    if any(use.used is False for use in uses):
        assert said.index("Not used") < said.index(" Used ")
    thumbnail = re.search(r'class="board-thumb" src="([^"]+)"', table)
    assert thumbnail is not None
    assert web.browser("auditor").get(thumbnail[1]).status_code == 200


def test_images_of_a_hand_eye_calibration_with_a_step_of_its_own_count_as_used(web: WebSite) -> None:
    """The page of exvivo_spine said "0 used, 30 not", and nothing of the other 90."""
    run_id = begin_calibrated_run(web)
    log = web.site.run(run_id)
    found = calibration_of(log)
    assert found is not None
    (views,) = found.captures
    result = copy.deepcopy(dict(log.state.steps["calibration"].result))
    intrinsics = result["details"]["intrinsics"]
    intrinsics["images"] = [f"a{name[1:]}" for name in intrinsics["images"]]  # those of an earlier step
    intrinsics["excluded"] = []
    hand_eye = dataclasses.replace(log.state.steps["calibration"], result=result)
    assert found.best is not None
    placed = found.best.residuals.held_out_mm.keys()
    assert placed
    assert {view.viewpoint for view in views if board_use(hand_eye, view).used} == set(placed)

    first = [view.model_copy(update={"step": "earlier", "viewpoint": f"a{view.viewpoint[1:]}"}) for view in views]
    states = {"calibration": hand_eye, "earlier": hand_eye}
    both = dataclasses.replace(found, captures=(tuple(first), views), states=states)
    rows = {row.name: row for row in image_rows(both)}
    assert rows.keys() == {view.viewpoint for view in (*first, *views)}
    assert sum(row.use.used is True for row in rows.values()) == len(first) + len(placed)
