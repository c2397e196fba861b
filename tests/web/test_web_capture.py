"""Capture page, 3D view and calibration page: the record in words and figures, as far as it is known."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Generator
from html import unescape
from pathlib import Path

import numpy as np
import pytest

from service.core.geometry import apply, inverse, look_at
from service.core.records.run_events import StepNote, ViewpointFailed
from service.dataset.scene_view import Scene, SceneSphere, scene_json, viewing_frame
from service.steps.context import StationLayout
from service.web.calibration_boards import empty_regions
from service.web.capture_view import WIDTH, StepViewpoint, plan_drawing
from service.web.charts import LEVELS, dots, heat_map, vector_field
from service.web.planned_poses import StationPlan
from tests.support.pages.browsed_run import BrowsedRun, words
from tests.support.pages.forms import forms_of
from tests.support.pages.web import web_site
from tests.support.record.core import EYE
from tests.support.recorded.calibrated_run import VIEWS, begin_calibrated_run, capture
from tests.support.runs.recorded_run import record_run
from tests.support.soak.large_record import LargeRecord


@pytest.fixture
def shown(tmp_path: Path) -> Generator[BrowsedRun]:
    with web_site(tmp_path) as site:
        run = begin_calibrated_run(site)
        browser = site.browser("technician")
        site.take_control(run, browser)
        yield BrowsedRun(site, browser, run)


# --- capture -----------------------------------------------------------------------------------------------------


def test_the_plan_shows_how_every_viewpoint_stands(shown: BrowsedRun) -> None:
    store = shown.site.store
    assert "To do 3" in shown.words()
    assert "No image of this step has been taken yet" in shown.words()
    capture(shown.site, shown.run, "capture", "v1_001", EYE, shade=1)
    plan = {"views": [{"viewpoint": f"v1_{i:03d}", "outcome": o, "reason": r} for i, o, r in
                      ((1, "feasible", ""), (2, "feasible", ""), (3, "refused", "too near to the table"),
                       (4, "feasible", ""))]}  # fmt: skip
    note = StepNote(step="capture", attempt=1, note="motion_plan", data={"stations": [plan]})
    failed = ViewpointFailed(step="capture", attempt=1, viewpoint="v1_004", error="E", message="no <file> arrived")
    store.record(shown.run, [note, failed], actor="runner")
    page = shown.words()
    for said in ("Done 1", "Next 1", "Failed 1", "Left out by the plan 1", "too near to the table", "1 of 4"):
        assert said in page, said
    assert "no <file> arrived" in page  # escaped in the page, otherwise it would be parsed as a tag


def test_a_run_of_a_thousand_viewpoints_is_shown_in_pages_and_drawn_without_overlap(tmp_path: Path) -> None:
    record = LargeRecord(tmp_path, 1200, 2000)
    record.close()
    with web_site(tmp_path) as site:
        shown = BrowsedRun(site, site.browser("technician"), record.run_id)
        html = shown.browser.get(f"/runs/{record.run_id}/capture").text
        assert "3 of 1200" in words(html)
        assert "All 1200 viewpoints as a table" in words(html)
        assert html.count('<th scope="row"><a class="button quiet"') == 200
        assert "Page 1 of 6" in words(html)
        assert "drawn as one" in words(html)
        symbols = re.findall(r'<g data-viewpoint="(v\d+)"', html)
        assert {"v004"} <= set(symbols), "the next one is among them"
        assert len(symbols) < 400
        last = shown.browser.get(f"/runs/{record.run_id}/capture?views=6").text
        assert "v1200" in last
        assert '<details id="viewpoints" data-keep="viewpoints" open>' in last
        chosen = shown.browser.get(f"/runs/{record.run_id}/capture?viewpoint=v777").text
        assert '<g data-viewpoint="v777"' in chosen
        assert "Page 4 of 6" in words(chosen)


def test_an_image_is_judged_in_words_with_the_figures_behind_them(shown: BrowsedRun) -> None:
    capture(shown.site, shown.run, "capture", "v1_001", EYE, shade=1)
    page = shown.words(viewpoint="v1_001")
    for said in ("Still", "σ 0.0020 mm", "limit 0.02 mm", "As wanted", "f/22 · 1/50 s · ISO 100", "not measured"):
        assert said in page, said
    board = shown.words(step="calibration", viewpoint="b003")
    assert re.search(r"Found corners 0\.\d{3} px rms", board)
    assert "registration sphere" not in board


def test_a_viewpoint_is_redone_with_a_reason_and_its_image_stays(shown: BrowsedRun) -> None:
    old = capture(shown.site, shown.run, "capture", "v1_001", EYE, shade=1)
    html = shown.browser.get(f"/runs/{shown.run}/capture?viewpoint=v1_001").text
    assert 'data-hold="1500"' in html, "the step runs: the robot drives there at once"
    reason = "<b>a drape</b> hung into it"
    (form,) = (form for form in forms_of(html) if form.hidden.get("verb") == "redo")
    sent = shown.browser.post(form.action, data=form.sent(reason=reason, preset=""), follow_redirects=False)
    assert sent.status_code == 303
    assert "To be redone 1" in shown.words()
    new = capture(shown.site, shown.run, "capture", "v1_001", EYE, shade=9)
    assert "Show 1 replaced" in shown.words()
    listed = shown.browser.get(f"/runs/{shown.run}/capture?replaced=true").text
    assert old in listed
    assert new in listed
    assert "<s>v1_001</s>" in listed
    assert "<b>a drape" not in listed
    assert reason in words(listed)


def test_who_looks_on_sees_everything_and_has_no_controls(shown: BrowsedRun) -> None:
    capture(shown.site, shown.run, "capture", "v1_001", EYE, shade=1)
    for role in ("auditor", "supervisor"):
        html = shown.site.browser(role).get(f"/runs/{shown.run}/capture?viewpoint=v1_001").text
        assert 'value="redo"' not in html
        assert "Still" in html


def test_parts_are_pieces_of_the_page(shown: BrowsedRun) -> None:
    capture(shown.site, shown.run, "capture", "v1_001", EYE, shade=1)
    whole = shown.browser.get(f"/runs/{shown.run}/capture").text
    for address in re.findall(r'data-part="([^"]+/capture/parts/[^"]+)"', whole):
        part = shown.browser.get(unescape(address))
        assert part.status_code == 200
        assert "<html" not in part.text
        assert words(part.text).strip()[:40] in words(whole)
    together = shown.browser.get(f"/runs/{shown.run}/capture/parts/image,plan,sheet").text
    assert re.findall(r'<template data-part="(\w+)">', together) == ["image", "plan", "sheet"]


def test_a_step_takes_many_images_page_by_page(shown: BrowsedRun) -> None:
    for i in range(65):
        capture(shown.site, shown.run, "capture", f"x{i:03d}", EYE, shade=i % 40)
    assert "Page 1 of 2" in shown.words()
    second = shown.browser.get(f"/runs/{shown.run}/capture?page=2").text
    assert second.count('loading="lazy"') == 5
    assert "Page 2 of 2" in shown.words(page=99)


def test_hostile_queries_are_harmless(shown: BrowsedRun) -> None:
    for query in ("viewpoint=<script>", "step=../../x", "viewpoint=%00", "seq=999999", "step=calibration&seq=1"):
        answer = shown.browser.get(f"/runs/{shown.run}/capture?{query}")
        assert answer.status_code == 200
        assert "<script>" not in answer.text
    assert shown.browser.get(f"/runs/{shown.run}/capture?page=0").status_code == 422
    assert shown.browser.get(f"/runs/{shown.run}/capture/parts/else").status_code == 422
    assert shown.browser.get("/runs/nowhere/capture").status_code == 404


def test_the_robots_side_is_at_the_bottom_and_the_scale_is_right() -> None:
    layout = StationLayout("s", "r", (0.7, 0.0, 0.0), (-1.0, 0.0, 0.0))
    near, far, left = (0.5, 0.0, 0.6), (0.9, 0.0, 0.6), (0.7, -0.25, 0.6)
    views = [
        StepViewpoint(name, "s", "open", "", place, (0.0, 0.0, -1.0), None, 0)
        for name, place in (("v_1", near), ("v_2", far), ("v_3", left))
    ]
    drawing = plan_drawing(StationPlan(layout, (0.3, 0.4)), views)
    assert drawing is not None
    at = {s.name: (s.x, s.y) for s in drawing.symbols}
    assert at["v_1"][1] > at["v_2"][1]
    assert at["v_1"][1] - at["v_2"][1] == pytest.approx(4 * drawing.bar, rel=0.01)
    assert at["v_1"][0] - at["v_3"][0] == pytest.approx(-2.5 * drawing.bar, rel=0.01) or at["v_3"][0] != at["v_1"][0]
    assert all(0 < x < WIDTH and 0 < y < drawing.height for x, y in at.values())
    assert [s.label for s in drawing.symbols] == ["1", "2", "3"]


# --- 3D view -----------------------------------------------------------------------------------------------------


def unpacked(array: dict[str, str]) -> np.ndarray:
    return np.frombuffer(base64.b64decode(array["bdata"]), "<" + array["dtype"])


def test_before_a_registration_the_3d_view_shows_what_is_planned(shown: BrowsedRun) -> None:
    page = shown.words("scene")
    assert "v1_004 to do" in page
    assert "nothing has been registered with the images yet" in page
    assert "of the robot base at station_1" in page


def test_a_registered_scene_is_drawn_in_a_frame_without_rights(tmp_path: Path) -> None:
    run = record_run(tmp_path)
    with web_site(tmp_path) as site:
        browser = site.browser("auditor")
        page = words(browser.get(f"/runs/{run}/scene").text)
        assert page.count("Registration") >= 10
        assert "of which the picture shows" in page
        outer = browser.get(f"/runs/{run}/scene")
        assert 'sandbox="allow-scripts"' in outer.text
        assert "unsafe-eval" not in outer.headers["content-security-policy"]
        inner = browser.get(f"/runs/{run}/scene/frame?theme=dark")
        policy = inner.headers["content-security-policy"]
        assert policy.startswith("sandbox allow-scripts;")
        assert "'unsafe-inline'" not in policy.split("script-src")[1].split(";")[0]
        assert "allow-same-origin" not in policy
        found = re.search(r'<script type="application/json" id="figure">(.*?)</script>', inner.text, re.DOTALL)
        assert found is not None
        figure = json.loads(found.group(1))
        surface = next(trace for trace in figure["data"] if trace["name"] == "surface")
        assert len(unpacked(surface["intensity"])) == len(unpacked(surface["x"]))
        assert unpacked(surface["i"]).max() < len(unpacked(surface["x"]))
        assert browser.get(f"/runs/{run}/scene/frame?theme=%22%3E").status_code == 422


def test_the_view_is_upright_with_the_first_robot_in_front() -> None:
    rng = np.random.default_rng(1)
    turn = look_at(rng.normal(size=3), rng.normal(size=3), np.array([0.0, 1.0, 0.0]))  # frame ← upright
    spheres = np.array([[0.1, 0.1, 0.0], [-0.1, 0.1, 0.0], [0.1, -0.1, 0.0], [-0.1, -0.1, 0.0]])
    eyes = [np.array([x, -0.2, 0.6]) for x in (-0.2, 0.0, 0.2)] + [np.array([0.0, 0.2, 0.6])]
    cameras = {f"v{i}": turn @ look_at(e, np.zeros(3), np.array([0.0, 1.0, 0.0])) for i, e in enumerate(eyes)}
    base = turn.copy()
    base[:3, 3] = apply(turn, np.array([[0.0, -0.8, 0.0]]))[0]
    scene = Scene(
        cameras=cameras,
        stations=dict.fromkeys(cameras, "station_1"),
        spheres=[SceneSphere(str(i), "registration", tuple(c)) for i, c in enumerate(apply(turn, spheres).tolist())],
        bases={"station_1": base},
        up=tuple((turn[:3, 2]).tolist()),
    )
    to_view = viewing_frame(scene)
    assert np.allclose(to_view[:3, :3] @ to_view[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.linalg.det(to_view[:3, :3]) == pytest.approx(1.0)
    assert np.allclose(apply(to_view, base[None, :3, 3]), [[0.0, -0.8, 0.0]], atol=1e-6)
    assert np.allclose(to_view @ turn, inverse(inverse(to_view @ turn)), atol=1e-9)
    figure = json.loads(scene_json(scene))
    ranges = [figure["layout"]["scene"][f"{a}axis"]["range"] for a in "xyz"]
    assert figure["layout"]["scene"]["aspectratio"]["y"] == pytest.approx((ranges[1][1] - ranges[1][0]) / 1000)
    assert ranges[1][0] < -800


def test_nothing_in_a_figure_ends_its_element() -> None:
    label = "</script><script>alert(1)</script>&"
    text = scene_json(Scene({}, {}, [SceneSphere(label, "control", (0.0, 0.0, 0.0))]))
    assert "<" not in text
    assert label in [name for trace in json.loads(text)["data"] for name in trace.get("text", ())]


# --- calibration -------------------------------------------------------------------------------------------------


def test_a_calibration_is_told_in_px_and_mm_with_what_to_add(shown: BrowsedRun) -> None:
    page = shown.words("calibration")
    for said in (
        "Hand-eye, held out",
        "mm median",
        "Within",
        "Uncertainty of a projected point, px",
        "Flange x, y, z",
    ):
        assert said in page, said
    assert page.count(" Used ") >= VIEWS - 1
    assert re.search(r"6 \d+° -?\d+° \d+° \d+ ± 0\.\d{4}", page), "six poses are suggested"


def test_a_certificate_names_lens_hash_chain_and_what_ends_it(shown: BrowsedRun) -> None:
    page = shown.words("calibration/certificate")
    log = shown.site.site.run(shown.run)
    state = log.state.steps["calibration"]
    for said in ("L-17", "B-4", "Bench arm", "20231", "Simulated", "f/22", state.artefacts[0].sha256,
                 state.passed_sha256, f"event {state.passed_seq}", "until the first of these"):  # fmt: skip
        assert said in page, said
    assert "None" not in page


def test_before_a_calibration_there_is_nothing_to_certify(tmp_path: Path) -> None:
    with web_site(tmp_path) as site:
        run = site.record_run()
        browser = site.browser("auditor")
        assert "no calibration yet" in browser.get(f"/runs/{run}/calibration").text
        assert browser.get(f"/runs/{run}/calibration/certificate").status_code == 409
        assert browser.get(f"/runs/{run}/scene").status_code == 200
        assert browser.get(f"/runs/{run}/scene/frame").status_code == 200
        assert "4 of 4" in words(browser.get(f"/runs/{run}/capture").text)


def test_charts_keep_their_values_in_their_drawing() -> None:
    heat = heat_map([[1.0, 10.0], [100.0, 1000.0]], (1200, 800), title="t", digits=1, logarithmic=True)
    assert [cell.level for cell in heat.cells] == [0, int(LEVELS / 3), int(2 * LEVELS / 3), LEVELS - 1]
    assert [cell.text for cell in heat.cells] == ["1.0", "10.0", "100.0", "1000.0"]
    field = vector_field([[[0.3, 0.0], [0.0, -0.1]]], [[9, 9]], (1000, 500), title="t")
    right, up = field.arrows
    assert right.x2 > right.x1
    assert up.y2 < up.y1
    assert (right.x2 - right.x1) == pytest.approx(3 * (up.y1 - up.y2), rel=0.02)
    assert field.bar == pytest.approx(2 * (up.y1 - up.y2), rel=0.02)
    chart = dots(["a", "b"], [("fit", [0.1, None]), ("held out", [0.2, 0.4])], title="t", limit=0.3, limit_text="x")
    assert len(chart.marks) == 3
    assert chart.limit is not None
    by = {(m.series, round(m.x)): m.y for m in chart.marks}
    assert min(by.values()) < chart.limit < max(by.values())
    assert dots(["a"], [("fit", [0.1])], title="t", limit=50.0).limit is None
    assert heat_map([[0.0, 0.0]], (100, 100), title="t").cells[0].level == 0


def test_empty_parts_of_the_image_are_named() -> None:
    corners = np.ones((8, 12), dtype=int)
    corners[:2, -3:] = 0
    corners[3, 5] = 0
    assert empty_regions(corners.tolist()) == [("upper right", 6, 12), ("middle centre", 1, 12)]
