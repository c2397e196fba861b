"""Drawing a region of the ground truth on the 3D view: its corners are the places that a finger touched."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect

from service.core.geometry import Array, apply
from service.core.records.run_events import RegionDrawn
from service.dataset.scene_view import viewing_frame
from service.followed_run import read_log
from service.run_start import recorded_run
from service.store.store import Store
from service.web.scene_data import scene_of
from tests.support.pages.at_the_table import STANDING
from tests.support.pages.browser import accessibility_faults, screen, served
from tests.support.pages.web import password_of, web_site
from tests.support.runs.attended import attended
from tests.support.runs.recorded_run import FUSION, PROTOCOL, record_run

pytestmark = [pytest.mark.timeout(300)]

EYE_M = np.array([0.0, -0.002, 1.7])  # of the view `Top`, which looks at the origin
HALF_ANGLE_RAD = np.pi / 8  # of plotly's lens, between the middle and the upper edge


# Where the drawing begins in the window, and its size. Playwright leaves the padding of a frame out of its boxes.
PLACE = """frame => {
    const box = frame.getBoundingClientRect(), style = getComputedStyle(frame);
    return [box.left + frame.clientLeft + parseFloat(style.paddingLeft),
            box.top + frame.clientTop + parseFloat(style.paddingTop)];
}"""
DRAWING = """() => {
    const chart = document.getElementById("chart"), box = chart.getBoundingClientRect();
    const { l, t, w, h } = chart._fullLayout._size;
    return [box.left + l, box.top + t, w, h];
}"""


def seen_from_the_top(page: Page, points_m: Array) -> list[tuple[float, float]]:
    """Pixels of the window where the view `Top` shows points (N, 3) of the drawing."""
    begins = page.locator(".scene-frame").evaluate(PLACE)
    left, top, width, height = page.frames[1].evaluate(DRAWING)
    forward, right = -EYE_M / np.linalg.norm(EYE_M), np.array([1.0, 0.0, 0.0])
    x, y, z = np.stack([right, np.cross(forward, right), forward]) @ (points_m - EYE_M).T
    scale = height / 2 / np.tan(HALF_ANGLE_RAD)
    u = begins[0] + left + width / 2 + scale * x / z
    v = begins[1] + top + height / 2 + scale * y / z
    return [(float(a), float(b)) for a, b in zip(u, v, strict=True)]


@pytest.mark.slow
def test_the_corners_that_a_finger_touches_are_recorded(tmp_path: Path, browser: Browser) -> None:
    run_id = record_run(tmp_path, complete=False, protocol=PROTOCOL + FUSION)
    with web_site(tmp_path):  # creates its people
        pass
    with Store.open(tmp_path / "data") as store:
        protocol, _ = recorded_run(store, run_id)
        scene = scene_of(read_log(store, run_id, protocol)).scene
    to_view = viewing_frame(scene)
    centres = apply(to_view, np.array([sphere.centre_m for sphere in scene.spheres]))
    # Around three spheres, a few millimetres beside their tops.
    touched = centres[[0, 3, 6]] + np.array([[0.004, 0.003, 0.0], [-0.005, 0.002, 0.0], [0.003, -0.004, 0.0]])
    offset = touched - centres[[0, 3, 6]]
    touched[:, 2] += np.sqrt(scene.radius_m**2 - np.sum(offset[:, :2] ** 2, axis=1))
    rig, data = tmp_path / "rig.yaml", tmp_path / "data"
    with (
        served(rig, data, "--protocols", str(tmp_path / "protocols")) as server,
        attended(data, {run_id: STANDING}),
        screen(browser, server.url, touch=True) as shown,
    ):
        shown.sign_in("grace", password_of("grace"))
        shown.go(f"/runs/{run_id}")
        shown.page.get_by_role("button", name="Take control").first.tap()
        expect(shown.page.get_by_role("button", name="End run").first).to_be_visible()
        shown.go(f"/runs/{run_id}/scene")
        frame = shown.page.frames[1]
        expect(frame.locator("#chart[data-drawn]")).to_have_count(1, timeout=60_000)
        frame.get_by_role("button", name="Top").tap()
        frame.get_by_role("button", name="Draw a region").tap()
        frame.locator("#chart").evaluate("chart => chart.scrollIntoView({ block: 'end' })")
        pixels = seen_from_the_top(shown.page, touched)
        for pixel in pixels[:2]:
            shown.page.touchscreen.tap(*pixel)
        expect(frame.get_by_role("button", name="Close the region")).to_be_disabled()  # two corners are no region
        shown.page.touchscreen.tap(pixels[0][0] + 120, pixels[0][1])
        expect(frame.locator("#drawn")).to_have_text("There is no surface under this place.")
        shown.page.touchscreen.tap(*pixels[2])
        expect(frame.locator("#region circle")).to_have_count(3)
        assert accessibility_faults(shown.page) == []
        frame.get_by_role("button", name="Close the region").tap()
        shown.page.get_by_role("button", name="CT: it is wound").tap()
        expect(shown.page.get_by_text("grace: 3 corners, from the CT; not used yet")).to_be_visible(timeout=20_000)
    with Store.open(tmp_path / "data") as store:
        (drawn,) = (e for e in store.events(run_id) if isinstance(e.payload, RegionDrawn))
    assert isinstance(drawn.payload, RegionDrawn)
    assert drawn.actor == "grace"
    corners = apply(to_view, np.array(drawn.payload.corners_m))
    assert np.abs(corners - touched).max() < 0.0025  # the page shows a simplified mesh, of 60,000 triangles
    along = to_view[:3, :3] @ np.array(drawn.payload.seen_along)
    assert along @ (EYE_M - corners.mean(axis=0)) / np.linalg.norm(EYE_M - corners.mean(axis=0)) > 0.999
