"""A whole small run with a simulated industrial camera and with a video source: from doctor to the evaluation.

Through harvesters, which differs from Aravis in how the images come alone, the run ends with the photographs.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from service.core.geometry import Transform, inverse, rotation_angle_rad
from service.core.records.run_events import ViewpointCaptured
from service.dataset.summary import summarise
from service.run_start import recorded_run
from service.steps.kinds.calibration import Result
from service.store.store import Store
from tests.support.protocols.one_side import VIEWS, one_side
from tests.support.rig.gentl_producer import ADDRESS_VARIABLE, compiled_producer
from tests.support.rig.rig import orthocapture, simulated_rig

pytestmark = [pytest.mark.timeout(1000)]
HOST = "127.0.0.64"


def protocol(path: Path, *, whole: bool) -> Path:
    """The demonstration from one side, or only its first photographs."""
    document = one_side("robot_corrected")
    if not whole:
        document["steps"] = [step for step in document["steps"] if step["id"] == "viewpoint_capture_1"]
    path.write_text(yaml.safe_dump(document, sort_keys=False, allow_unicode=True), encoding="utf-8")
    return path


def give_producer(rig: Path, producer: Path) -> None:
    """Let the rig read its camera through this GenTL producer."""
    record = yaml.safe_load(rig.read_text(encoding="utf-8"))
    record["devices"]["camera"]["producer"] = str(producer)
    rig.write_text(yaml.safe_dump(record, sort_keys=False), encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize(
    "way",
    [pytest.param(by, marks=pytest.mark.whole) for by in ("Aravis", "harvesters", "OpenCV")],
)
def test_doctor_and_a_whole_small_run(way: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(ADDRESS_VARIABLE, HOST)
    model, whole = "video" if way == "OpenCV" else "GigE Vision", way != "harvesters"
    options = ("--scene", "7", "--image-width", "720" if whole else "480", "--speed-up", "10", "--camera", model)
    data, folder = tmp_path / "data", tmp_path / "rig"
    folder.mkdir()
    with simulated_rig(folder, *options, host=HOST) as rig:
        if way == "harvesters":
            give_producer(Path(rig["rig"]), compiled_producer(tmp_path))
        doctor = orthocapture("doctor", "--rig", rig["rig"], "--json")
        told = json.loads(doctor.stdout)["devices"]["camera"]
        assert told["ok"], told
        assert told["identity"]["driver_version"].split()[0] == way
        answer = orthocapture(
            "run", str(protocol(tmp_path / "small.yaml", whole=whole)), "--rig", rig["rig"],
            "--data", str(data), "--operator", "Ada", "--auto-confirm", "--json", timeout_s=900,
        )  # fmt: skip
        assert answer.returncode == 0, answer.stdout[-2000:] + answer.stderr[-3000:]
        truth = json.loads(Path(rig["truth"]).read_text())
        log = [json.loads(row) for row in (folder / "truth_exposures.jsonl").read_text().splitlines()]
    with Store.open(data, create=False) as store:
        run_id = store.find_run("latest")
        summary = summarise(store, run_id, recorded_run(store, run_id)[0])
    assert summary.state.status == "completed"
    captured = [e.payload for e in summary.events if isinstance(e.payload, ViewpointCaptured)]
    assert len({one.viewpoint for one in captured if one.viewpoint.startswith("v")}) == VIEWS
    assert all(one.verdicts["settings"] for one in captured)
    T_flange_camera = truth["T_flange_camera"]
    if whole:
        (row,) = summary.table()
        assert (row.poses, row.mean_radial_error_mm < 0.35) == ("robot_corrected", True), row
        found = Result.model_validate(summary.state.steps["camera_calibration"].result)
        lens = truth["intrinsics"]
        assert (found.camera.fx, found.camera.fy) == pytest.approx((lens["fx"], lens["fy"]), rel=0.003)
        T_flange_camera = found.T_flange_camera
    assert_shown_from_there(captured, np.array(truth["T_world_base"]["station_1"]), np.array(T_flange_camera), log)


def assert_shown_from_there(
    captured: list[ViewpointCaptured], T_world_base: Transform, T_flange_camera: Transform, log: list[dict[str, Any]]
) -> None:
    """Each photograph was exposed where the recorded pose of the arm has the camera."""
    seen = {row.get("sha256"): np.array(row["T_world_camera"]) for row in log if "sha256" in row}
    for one in captured:
        T_world_camera = T_world_base @ np.array(one.T_base_flange) @ T_flange_camera
        # An industrial camera knows no files: its exposures are compared by their places.
        exposures = [seen[one.artefacts[0].sha256]] if seen else [np.array(row["T_world_camera"]) for row in log]
        gaps = [inverse(T) @ T_world_camera for T in exposures]
        assert min(np.linalg.norm(gap[:3, 3]) for gap in gaps) < 0.004
        assert min(rotation_angle_rad(gap) for gap in gaps) < np.radians(0.5)
