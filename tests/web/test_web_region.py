"""A region of the ground truth drawn on the 3D view: who may, what is recorded, and what is refused."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from service.computations import fuse
from service.core.geometry import apply
from service.core.records.run_events import RegionDrawn
from service.core.run.fold import fold
from service.core.run.state import JobState
from service.dataset.scene_view import scene_json, viewing_frame
from service.followed_run import RunRecord, read_log
from service.run_start import recorded_run
from service.web.scene_data import scene_of
from tests.support.pages.web import Browser, WebSite, web_site
from tests.support.runs.recorded_run import FUSION, PROTOCOL, record_run

CORNERS = [[0.01, 0.0, 0.02], [0.03, 0.0, 0.02], [0.02, 0.02, 0.025]]
FORM = {"source": "ct", "corners": json.dumps(CORNERS), "along": "[0, 0, 1]"}


@contextmanager
def fusing_site(folder: Path) -> Generator[tuple[WebSite, Browser, str]]:
    """A run that has been registered and is to be fused, and a technician who controls it."""
    run = record_run(folder, complete=False, protocol=PROTOCOL + FUSION)
    with web_site(folder) as site:
        browser = site.browser("technician")
        site.take_control(run, browser)
        yield site, browser, run


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Generator[tuple[WebSite, Browser, str]]:
    """A site for tests that draw nothing, or try to in vain."""
    with fusing_site(tmp_path_factory.mktemp("fusing")) as fusing:
        yield fusing


@pytest.fixture
def drawn_on(tmp_path: Path) -> Generator[tuple[WebSite, Browser, str]]:
    """A site for a test that draws."""
    with fusing_site(tmp_path) as fusing:
        yield fusing


def drawn(site: WebSite, run: str) -> list[tuple[str, RegionDrawn]]:
    """Who drew what, by the record."""
    events = site.store.events(run)
    return [(e.actor, e.payload) for e in events if isinstance(e.payload, RegionDrawn)]


@pytest.mark.slow
def test_a_region_is_recorded_with_the_name_of_who_drew_it(drawn_on: tuple[WebSite, Browser, str]) -> None:
    site, browser, run = drawn_on
    page = browser.get(f"/runs/{run}/scene").text
    assert 'action="/runs/' + run + '/scene/region"' in page
    frame = browser.get(f"/runs/{run}/scene/frame").text
    assert "Draw a region" in frame
    told = re.search(r'data-to-view="([^"]*)"', frame)
    assert told is not None
    to_view = np.array(json.loads(told.group(1).replace("&#34;", '"')))
    assert to_view[:3, :3] @ to_view[:3, :3].T == pytest.approx(np.eye(3), abs=1e-9)
    assert browser.send_form(f"/runs/{run}/scene/region", **FORM).status_code == 303
    ((by, region),) = drawn(site, run)
    assert by == "grace"
    assert region.step == "ground_truth"
    assert region.source == "ct"
    assert np.array(region.corners_m) == pytest.approx(np.array(CORNERS))
    protocol, _ = recorded_run(site.store, run)
    assert [found.by for found in fold(protocol, site.store.events(run)).drawn] == ["grace"]
    after = browser.get(f"/runs/{run}/scene").text
    assert "grace: 3 corners, from the CT; not used yet" in after


def test_the_wound_that_the_last_fusion_used_is_outlined(shown: tuple[WebSite, Browser, str]) -> None:
    site, _, run = shown
    protocol, _ = recorded_run(site.store, run)
    before = read_log(site.store, run, protocol)
    assert scene_of(before).scene.outlines == {}
    eye = tuple(tuple(float(row == column) for column in range(6)) for row in range(6))
    corners = ((0.01, 0.0, 0.02), (0.03, 0.0, 0.02), (0.02, 0.02, 0.02))
    answer = fuse.Answer(T_scan_ct=tuple(row[:4] for row in eye[:4]), covariance=eye, wound_m=corners)
    jobs = {
        name: JobState(name, "fuse", 1, seq, name, {}, status="finished", result=found.model_dump(mode="json"))
        for name, seq, found in (("second", 9, answer), ("first", 7, answer.model_copy(update={"wound_m": ()})))
    }
    steps = {**before.state.steps, "ground_truth": replace(before.state.steps["ground_truth"], jobs=jobs)}
    log = RunRecord(run, protocol, tuple(before.events), replace(before.state, steps=steps), site.store)
    scene = scene_of(log).scene
    (line,) = (
        trace for trace in json.loads(scene_json(scene))["data"] if trace.get("name") == "wound of the last fusion"
    )
    drawn_mm = np.stack([np.frombuffer(base64.b64decode(line[axis]["bdata"]), dtype="<f4") for axis in "xyz"], axis=1)
    assert drawn_mm == pytest.approx(1e3 * apply(viewing_frame(scene), np.array([*corners, corners[0]])), abs=1e-3)


@pytest.mark.parametrize(
    "wrong",
    [
        {"corners": json.dumps(CORNERS[:2])},
        {"corners": "[[0, 0, NaN], [0, 1, 0], [1, 0, 0]]"},
        {"corners": "[[0, 0, 1e9], [0, 1, 0], [1, 0, 0]]"},
        {"corners": "{"},
        {"corners": '"x"'},
        {"corners": "[" * 39_000},
        {"corners": f"[[{'9' * 5_000}, 0, 0], [0, 1, 0], [1, 0, 0]]"},
        {"along": "[0, 0, 0]"},
        {"along": "[0, NaN, 0]"},
        {"source": "air"},
    ],
)
def test_what_is_no_region_is_refused(shown: tuple[WebSite, Browser, str], wrong: dict[str, str]) -> None:
    site, browser, run = shown
    assert 400 <= browser.send_form(f"/runs/{run}/scene/region", **{**FORM, **wrong}).status_code < 500
    assert not drawn(site, run)


def test_only_who_controls_the_run_draws(shown: tuple[WebSite, Browser, str]) -> None:
    site, _, run = shown
    auditor = site.browser("auditor")
    assert auditor.send_form(f"/runs/{run}/scene/region", **FORM).status_code == 403
    assert "Draw a region" not in auditor.get(f"/runs/{run}/scene/frame").text
    supervisor = site.browser("supervisor")
    assert supervisor.send_form(f"/runs/{run}/scene/region", **FORM).status_code in (403, 409)
    assert "Take control of the run first" in supervisor.get(f"/runs/{run}/scene").text
    assert not drawn(site, run)


def test_without_a_fusion_to_come_there_is_nothing_to_draw(tmp_path: Path) -> None:
    run = record_run(tmp_path)
    with web_site(tmp_path) as site:
        browser = site.browser("technician")
        assert "Draw a region" not in browser.get(f"/runs/{run}/scene/frame").text
        site.take_control(run, browser)
        assert browser.send_form(f"/runs/{run}/scene/region", **FORM).status_code == 409
