"""The page of a run's data set: what is ready is shown, the rest is made in the background, names are only words."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from service.audit.recorded_run import read_run
from service.computations.benchmark import BenchmarkResult, ComputingEffort, Machine, Score
from service.core.records.run_events import EvidenceExported
from service.dataset.preview_records import (
    DecidedRegion,
    GroundTruthPreview,
    Preview,
    ViewPreview,
    read_preview,
    write_preview,
)
from service.dataset.run_data_set import data_set_of
from service.dataset.scene_view import decimated
from service.web.dataset import Previews
from tests.support.pages.web import Browser, WebSite, web_site
from tests.support.recorded.reported_run import record_reported_run
from tests.support.recorded.unpacked_run import unpack_recorded_run

pytestmark = pytest.mark.timeout(600)


@pytest.fixture(scope="module")
def web(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WebSite]:
    """The recorded run, whose preview is ready."""
    folder = tmp_path_factory.mktemp("web")
    unpack_recorded_run(folder)
    with web_site(folder) as made:
        run = made.store.find_run("latest")
        assert made.browser("auditor").get(f"/runs/{run}/dataset").status_code == 200
        previews(made).wait(run, 250)
        yield made


@pytest.fixture
def run(web: WebSite) -> str:
    return web.store.runs()[0].run_id


@pytest.fixture
def auditor(web: WebSite) -> Browser:
    return web.browser("auditor")


def previews(web: WebSite) -> Previews:
    found: Previews = web.app.state.previews
    return found


def preview_of(web: WebSite, run: str) -> Preview:
    found = previews(web).ready(web.site.run(run).state)
    assert found is not None
    assert found.whole, previews(web).making(run)
    return found


def picture(browser: Browser, run: str, name: str) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    answer = browser.get(f"/runs/{run}/dataset/pictures/{name}")
    assert answer.status_code == 200, name
    found = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert found is not None
    return np.asarray(found, dtype=np.uint8)


def test_the_page_shows_every_view_with_its_splits_and_pictures(web: WebSite, run: str, auditor: Browser) -> None:
    dataset = data_set_of(read_run(web.site.data, run).summary())
    page = auditor.get(f"/runs/{run}/dataset").text
    assert "data-pending" not in page
    for split, names in dataset.splits.named().items():
        part = auditor.get(f"/runs/{run}/dataset?split={split}").text
        assert re.findall(r'class="view-name">([^<]+)<', part) == list(names), split
    for name in set(re.findall(rf"/runs/{run}/dataset/pictures/([^\"]+)", page)):
        assert picture(auditor, run, name).size > 0


def test_the_picture_of_the_depth_lies_over_the_photograph(web: WebSite, run: str, auditor: Browser) -> None:
    """Opaque where the full depth has a surface, transparent elsewhere, and near is brighter than far."""
    dataset = data_set_of(read_run(web.site.data, run).summary())
    shown = preview_of(web, run).views
    for view, small in list(zip(dataset.views, shown, strict=True))[::3]:
        depth_m = dataset.pixels.depth_m(view)
        photograph, depth = picture(auditor, run, small.image), picture(auditor, run, small.depth)
        assert photograph.shape[:2] == depth.shape[:2] == depth_m.shape  # the recorded photographs are small
        assert np.mean((depth[..., 3] > 127) == (depth_m > 0)) > 0.999
        near, far = (
            depth[np.isclose(depth_m, mm / 1e3, atol=5e-3)][:, 1].mean() for mm in (small.near_mm, small.far_mm)
        )
        assert near > far + 80, "green rises from violet to yellow"


def test_every_surface_is_shown_from_the_side_of_the_cameras(web: WebSite, run: str) -> None:
    """The scan's own axes point anywhere; in the drawing the cameras are above, also where they are not drawn."""
    folder, preview = next((web.site.data / "cache" / "dataset").iterdir()), preview_of(web, run)
    assert preview.distances is not None
    heights_mm = [surface_mm(folder / name)[:, 2] for name in ("coverage.json", preview.distances.figure)]
    summary = read_run(web.site.data, run).summary()
    record = summary.registrations()[summary.best() or ""]
    eyes_m = np.array([np.array(T)[:3, 3] for T in record.T_scan_camera.values()])
    spheres_m = np.array(summary.scan_spheres_m())
    up = eyes_m.mean(axis=0) - spheres_m.mean(axis=0)
    points_m, _ = decimated(*summary.scan_mesh())
    for found_mm in heights_mm:
        expected_mm = 1e3 * (points_m - spheres_m.mean(axis=0)) @ up / np.linalg.norm(up)
        assert found_mm == pytest.approx(expected_mm, abs=0.01)


def surface_mm(path: Path) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """(V, 3) vertices of the surface in a figure."""
    surface = next(t for t in json.loads(path.read_text(encoding="utf-8"))["data"] if t.get("name") == "surface")
    return np.stack(
        [np.frombuffer(base64.b64decode(surface[axis]["bdata"]), "<f4").astype(np.float64) for axis in "xyz"], axis=1
    )


def test_crops_on_the_page_are_free_of_markers(web: WebSite, run: str) -> None:
    dataset, shown = data_set_of(read_run(web.site.data, run).summary()), preview_of(web, run)
    views = {view.name: view for view in dataset.views}
    crops = [(small.name, crop) for small in shown.views for crop in small.crops]
    assert crops
    for name, crop in crops:
        markers = dataset.pixels.markers(views[name])[crop.y : crop.y + crop.height, crop.x : crop.x + crop.width]
        assert markers.shape == (crop.height, crop.width) == shown.crop[::-1]
        assert not markers.any()


def test_coverage_and_distances_are_told_and_drawn(web: WebSite, run: str, auditor: Browser) -> None:
    shown = preview_of(web, run)
    assert shown.coverage is not None
    assert shown.distances is not None, shown.no_distances
    shares = shown.coverage.shares
    assert 1 >= shares[0] >= shares[1] >= shares[2] >= shares[3] >= 0
    assert shares[0] > 0.5
    page = auditor.get(f"/runs/{run}/dataset").text
    assert f"{shown.distances.chamfer_mm:.3f} mm" in page
    assert 0 < shown.distances.ct_to_scan_median_mm < 2
    assert shown.distances.floor_mm < shown.distances.chamfer_mm < shown.distances.outlier_mm
    assert picture(auditor, run, shown.distances.picture).shape[2] == 3
    for figure in ("coverage", "distances"):
        frame = auditor.get(f"/runs/{run}/dataset/{figure}/frame")
        assert "sandbox allow-scripts" in frame.headers["content-security-policy"]
        found = re.search(r'id="figure">(.+?)</script>', frame.text, re.DOTALL)
        assert found is not None
        mesh = json.loads(found[1])["data"][0]
        assert (mesh["type"], "intensity" in mesh) == ("mesh3d", True)
    assert auditor.get(f"/runs/{run}/dataset/other/frame").status_code == 422


def test_the_figures_of_a_fused_mesh_are_told(web: WebSite, run: str, auditor: Browser) -> None:
    """Where there is no fusion, the page says that the mesh is the scan's."""
    assert "this run has no step that fused CT and scan" in auditor.get(f"/runs/{run}/dataset").text
    folder = next((web.site.data / "cache" / "dataset").glob(f"{run}-*"))
    before = preview_of(web, run)
    assert before.distances is not None
    truth = GroundTruthPreview(
        step="Fuse <both>", ct_share=0.125, scan_share=0.75, blend_share=0.125, sigma_median_mm=0.031,
        sigma_high_mm=0.222, distance_change_max_mm=0.017, loop_closure_mm=0.043, faces=4711,
        regions=(DecidedRegion("ct", "grace <b>"),), sources="sources.json", sigmas="sigmas.json",
    )  # fmt: skip
    distances = replace(before.distances, step="Fuse <both>", excluded=None)
    try:
        (folder / "sources.json").write_text('{"data": []}')
        write_preview(folder, replace(before, ground_truth=truth, distances=distances))
        page = auditor.get(f"/runs/{run}/dataset").text
        for told in ("12.5 % of the vertices", "median 0.031 mm", "0.222 mm", "0.043 mm", "CT by grace &lt;b&gt;"):
            assert told in page, told
        assert page.count("Fuse &lt;both&gt;") == 2
        assert auditor.get(f"/runs/{run}/dataset/sources/frame").status_code == 200
        assert auditor.get(f"/runs/{run}/dataset/sigmas/frame").status_code == 404
    finally:
        write_preview(folder, before)


@pytest.mark.parametrize("name", ["preview.json", "..%2Fpreview.json", "v0000-thumb.png", "x.jpg", "%00.jpg"])
def test_nothing_but_pictures_is_sent(web: WebSite, run: str, auditor: Browser, name: str) -> None:
    assert auditor.get(f"/runs/{run}/dataset/pictures/{name}").status_code == 404


def test_a_name_on_the_page_is_escaped(web: WebSite, run: str, auditor: Browser) -> None:
    state = web.site.run(run).state
    folder = next((web.site.data / "cache" / "dataset").glob(f"{run}-*"))
    before = read_preview(folder)
    assert before is not None
    hostile = '"><script>alert(1)</script>&view=x'
    view = ViewPreview(hostile, 10, 10, ("dense", hostile), "a.jpg", "b.jpg", "c.webp", 1, 2, ready=True)
    try:
        write_preview(folder, Preview((view,), (4, 4), no_distances=hostile, whole=True))
        assert previews(web).ready(state) is not None
        page = auditor.get(f"/runs/{run}/dataset").text
        assert "<script>alert" not in page
        assert page.count("&lt;script&gt;alert(1)") >= 5
        assert "view=%22%3E%3Cscript%3Ealert%281%29%3C/script%3E%26view%3Dx#depth" in page
        assert auditor.get(f"/runs/{run}/dataset", params={"view": hostile}).status_code == 200
    finally:
        write_preview(folder, before)
    assert auditor.get(f"/runs/{run}/dataset?split={hostile}").status_code == 422


def test_what_cannot_be_made_is_told_and_can_be_tried_again(web: WebSite, auditor: Browser) -> None:
    """The photographs of this run are smaller than its camera says."""
    run = record_reported_run(web.folder, registered=True)
    assert "being made" in auditor.get(f"/runs/{run}/dataset").text
    previews(web).wait(run, 250)
    page = auditor.get(f"/runs/{run}/dataset").text
    assert "The pictures could not be made" in page
    assert "data-pending" not in page
    assert auditor.send_form(f"/runs/{run}/dataset").status_code == 303
    assert auditor.send_form(f"/runs/{run}/dataset", csrf="forged").status_code == 403
    previews(web).wait(run, 250)


def test_a_run_that_is_not_complete_has_none(web: WebSite, auditor: Browser) -> None:
    run = record_reported_run(web.folder, error_mm=0.9, registered=True)
    page = auditor.get(f"/runs/{run}/dataset").text
    assert "There is no data set yet" in page
    assert auditor.send_form(f"/runs/{run}/dataset").status_code == 409
    assert previews(web).making(run) is None
    assert auditor.get("/runs/nothing/dataset").status_code == 404
    assert web.browser().get(f"/runs/{run}/dataset", follow_redirects=False).status_code in (303, 401)


def test_the_benchmark_of_an_exported_data_set_is_shown(web: WebSite, run: str, auditor: Browser) -> None:
    assert "None yet" in auditor.get(f"/runs/{run}/dataset").text
    ours, other = "a" * 64, "b" * 64
    left = EvidenceExported(what="dataset", file_name="x", sha256=ours, size_bytes=1, head_sha256="0" * 64)
    web.store.record(run, [left], actor="emmy")
    rows = [("colmap", ours, 0.4, ""), ("<b>mine", ours, None, "it <i>failed"), ("neus2", other, 0.3, "")]
    for method, dataset, chamfer_mm, failure in rows:
        folder = web.site.data / "benchmark" / f"{'mine' if failure else method}-dense"
        folder.mkdir(parents=True)
        (folder / "result.json").write_text(result(method, dataset, chamfer_mm, failure).model_dump_json())
    page = auditor.get(f"/runs/{run}/dataset").text
    assert "<strong>0.400</strong>" in page
    assert "&lt;b&gt;mine" in page
    assert "No mesh. it &lt;i&gt;failed" in page
    assert "neus2" not in page
    (web.site.data / "benchmark" / "colmap-dense" / "result.json").write_text("{}")
    page = auditor.get(f"/runs/{run}/dataset")
    assert (page.status_code, "The results cannot be read" in page.text) == (200, True)


def result(method: str, dataset_sha256: str, chamfer_mm: float | None, failure: str) -> BenchmarkResult:
    """What the benchmark keeps of a method."""
    score = None
    if chamfer_mm is not None:
        score = Score(
            chamfer_mm=chamfer_mm, accuracy_mm=0.3, completeness_mm=0.5, floor_mm=0.04, spacing_mm=0.1,
            f_score_05=0.8, f_score_10=0.9, normal_consistency=0.9, outside_percent=0, excluded_percent=1,
            seen_percent=90,
        )  # fmt: skip
    return BenchmarkResult(
        method=method, scenario="dense", dataset_sha256=dataset_sha256, simulated=True, views=6,
        width=320, height=240, commands=(("colmap",),), elsewhere=False,
        effort=ComputingEffort(wall_s=60, cpu_s=100, peak_memory_mb=900), mesh_sha256="", faces=0, score=score,
        failure=failure, machine=Machine(processor="x", cores=2, memory_gb=4, gpu=""),
        finished_utc="2026-11-23T17:00:00Z",
    )  # fmt: skip
