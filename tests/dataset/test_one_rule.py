"""Page, report, audit, data set and demonstration name the same registration, the same scan and the same camera."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator

import numpy as np
import pytest

from service.audit.recorded_run import RecordedRun, read_run
from service.audit.report import report_content
from service.audit.report_output import render_html
from service.compute.camera_model import CameraModel
from service.core.geometry import Array
from service.core.run.state import RunState
from service.dataset.records import DataSet
from service.dataset.registrations import own_registration, registrations, signed_rows
from service.dataset.run_data_set import data_set_of
from service.dataset.view_covariances import pose_covariance
from service.followed_run import RunRecord
from service.store.store import Store
from service.store.verification.verify import verify
from service.web.outlines import displayed_registration, scan_spheres
from service.web.scene_data import scene_of
from tests.support.recorded.unpacked_run import unpack_recorded_run

pytestmark = pytest.mark.timeout(300)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    return read_run(unpack_recorded_run(tmp_path_factory.mktemp("recorded")), "latest")


def with_best(run: RecordedRun, name: str) -> RecordedRun:
    """The run as if the evaluation had found the smallest error for this registration."""
    step = next(step.id for step in run.protocol.steps if step.gives == "accuracy")
    result = dict(run.state.steps[step].result)
    others = [row for row in result["table"] if row["poses"] != name]
    result["table"] = [*others, {**result["table"][0], "poses": name, "source": name, "mean_radial_error_mm": 1e-6}]
    return dataclasses.replace(run, state=_with_result(run, step, result))


def with_scan(run: RecordedRun, scan: str) -> RecordedRun:
    """The run as if its registration had used this scan."""
    steps = tuple(
        step.model_copy(update={"params": step.params.model_copy(update={"scan": scan})})
        if step.gives == "registrations"
        else step
        for step in run.protocol.steps
    )
    return dataclasses.replace(run, protocol=run.protocol.model_copy(update={"steps": steps}))


def _with_result(run: RecordedRun, step: str, result: dict[str, object]) -> RunState:
    changed = dataclasses.replace(run.state.steps[step], result=result)
    return dataclasses.replace(run.state, steps={**run.state.steps, step: changed})


@pytest.fixture(scope="module")
def store(run: RecordedRun) -> Iterator[Store]:
    with Store.open(run.data_dir) as opened:
        yield opened


def page_of(run: RecordedRun, store: Store) -> RunRecord:
    return RunRecord(run.run_id, run.protocol, tuple(run.events), run.state, store)


def test_every_reader_takes_the_registration_that_the_evaluation_judged_best(run: RecordedRun, store: Store) -> None:
    signed = [row.poses for row in signed_rows(run.protocol, run.state)]
    names = [*signed, "hybrid"]  # which arrived later in the recorded run
    assert len(names) > 2, "the recorded run has several registrations"
    audit = verify(run.data_dir, run.run_id)
    for name in names:
        judged = with_best(run, name)
        log, summary = page_of(judged, store), judged.summary()
        record = registrations(judged.protocol, judged.state)[name]
        shown = displayed_registration(log)
        assert shown is not None
        assert {shown.name, summary.best(), own_registration(judged.protocol, judged.state)} == {name}
        dataset = data_set_of(summary)
        assert dataset.statement["pose_source"] == name
        assert dataset.about.accuracy is not None
        assert dataset.about.accuracy.poses == name
        # The poses of the page and of the data set are those of this registration, and so is the camera.
        on_page, camera = scene_of(log).scene.cameras, record.full_camera or record.camera
        for view in dataset.views:
            assert np.array_equal(view.T_world_camera, on_page[view.name])
            assert view.camera == CameraModel.from_record(camera.plain())
        report = render_html(report_content(judged, audit, with_scene=False, with_pictures=False))
        assert f"{name} (best)" in report
        assert [other for other in names if f"{other} (best)" in report] == [name]


def test_every_reader_takes_the_scan_that_the_registration_used(run: RecordedRun, store: Store) -> None:
    scans = [step.id for step in run.protocol.steps if step.gives == "scan_surface"]
    assert len(scans) > 1, "the recorded run has several scans"
    for scan in scans:
        used = with_scan(run, scan)
        log, summary = page_of(used, store), used.summary()
        mesh = summary.scan_mesh_file()
        assert mesh is not None
        assert mesh in used.state.steps[scan].artefacts
        assert scene_of(log).mesh == mesh
        on_page = [sphere.centre_m for sphere in scan_spheres(log) if sphere.kind == "registration"]
        assert on_page == list(summary.scan_spheres_m())


def test_hybrid_poses_bring_a_covariance_of_their_own(run: RecordedRun) -> None:
    def covariances(name: str) -> tuple[DataSet, dict[str, Array]]:
        dataset = data_set_of(with_best(run, name).summary())
        return dataset, {view.name: view.covariance for view in dataset.views}

    hybrid, whole = covariances("hybrid")
    corrected, shared = covariances("robot_corrected")
    (recorded,) = (item.ref for item in run.artefacts if item.ref.kind == "hybrid_poses")
    stated = json.loads(run.files.artefact_path(recorded.sha256).read_bytes())["pose_covariance"]
    for name, covariance in whole.items():
        assert np.array_equal(covariance, np.array(stated[name]))
        assert np.linalg.eigvalsh(covariance).min() > 0
    record = registrations(run.protocol, run.state)["robot_corrected"]
    T_world_scan, of_registration = np.array(record.T_world_scan), np.array(record.covariance)
    for view in corrected.views:
        assert np.array_equal(shared[view.name], pose_covariance(T_world_scan, of_registration, view.T_world_camera))
    adjusted, both = covariances("colmap")
    assert adjusted.pose_errors is not None
    record = registrations(run.protocol, run.state)["colmap"]
    T_world_scan, of_registration = np.array(record.T_world_scan), np.array(record.covariance)
    for k, view in enumerate(adjusted.views):
        block = slice(6 * k, 6 * k + 6)
        common = pose_covariance(T_world_scan, of_registration, view.T_world_camera)
        assert np.allclose(both[view.name], common + adjusted.pose_errors[block, block], rtol=1e-9, atol=0)
    assert "added as independent" in adjusted.about.covariance
    assert "all of it" in hybrid.about.covariance
    assert "none of single poses" in corrected.about.covariance
