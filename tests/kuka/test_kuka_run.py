"""A whole small run with a simulated KUKA that is moved between the stations, from doctor to the evaluation."""

from __future__ import annotations

import json
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from service.core.records.events import ViewpointCaptured
from tests.support.protocols.small_demo import small_demo
from tests.support.rig.rig import orthocapture, simulated_rig
from tests.support.runs.ended_run import EndedRun, ended_run, patient

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]
ARM = "LBR Med 14"
# Where its arm cannot take the poses that the demonstration lists for a larger one, the software plans them.
BOARD_POSES = {
    "station": "station_1", "prefix": "b", "count": 24, "tilts_deg": [8, 20, 32, 38],
    "rolls_deg": [0, 12, -12, 180, 168], "distances_m": [0.62, 0.68, 0.74], "above_scene_m": 0.09, "coverage": 0.9,
}  # fmt: skip
# With three views a station, the poses of an arm that repeats to 0.15 mm are not what the demonstration asks for.
WIDER = {"predicted_target_error_mm": 1.5, "robot_corrected_rms_px": 2.0}


@dataclass(frozen=True)
class Run:
    """The run that the tests of this file share."""

    ended: EndedRun
    doctor: dict[str, Any]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Generator[Run]:
    folder = tmp_path_factory.mktemp("kuka")
    protocol, data = folder / "demo.yaml", folder / "data"
    record = yaml.safe_load(small_demo(protocol).read_text(encoding="utf-8"))
    (calibration,) = (step for step in record["steps"] if step["kind"] == "calibration")
    del calibration["params"]["viewpoints"]
    calibration["params"]["board_poses"] = BOARD_POSES
    for gate in (gate for step in record["steps"] for gate in step.get("gates", [])):
        gate["max"] = WIDER.get(gate["measure"], gate.get("max"))
        if gate["max"] is None:
            del gate["max"]
    protocol.write_text(yaml.safe_dump(record, sort_keys=False, allow_unicode=True), encoding="utf-8")
    options = ("--scene", "7", "--image-width", "960", "--ct-voxel-mm", "1.0", "--speed-up", "10", "--arm", ARM)
    with simulated_rig(folder, *options, host="127.0.0.44") as rig:
        patient(Path(rig["rig"]), answer_timeout_s=20.0)
        doctor = orthocapture("doctor", "--rig", rig["rig"], "--json")
        answer = orthocapture(
            "run", str(protocol), "--rig", rig["rig"], "--data", str(data), "--operator", "Ada", "--auto-confirm",
            "--json", timeout_s=1100,
        )  # fmt: skip
    assert answer.returncode == 0, answer.stdout[-2000:] + answer.stderr[-3000:]
    with ended_run(data, Path(rig["truth"])) as ended:
        yield Run(ended, json.loads(doctor.stdout))


def test_it_comes_to_its_end_with_every_view(run: Run) -> None:
    state = run.ended.summary.state
    assert state.status == "completed"
    assert not any(step.skipped_viewpoints for step in state.steps.values())
    captured = [e.payload for e in run.ended.summary.events if isinstance(e.payload, ViewpointCaptured)]
    assert all(len(one.joints_rad) == 7 for one in captured)
    robot = run.doctor["devices"]["robot"]
    assert (robot["ok"], robot["identity"]["model"], robot["identity"]["driver"]) == (True, ARM, "kuka_sunrise")


def test_its_errors_are_those_of_a_good_data_set(run: Run) -> None:
    rows = {row.poses: row for row in run.ended.summary.table()}
    assert set(rows) == {"robot", "robot_corrected"}
    assert run.ended.true_mm["robot"] < 1.0  # the arm's own error
    assert run.ended.true_mm["robot_corrected"] < 0.35
    assert rows["robot_corrected"].mean_radial_error_mm < rows["robot"].mean_radial_error_mm


def test_the_correction_has_seven_joints(run: Run) -> None:
    calibrated = run.ended.summary.state.steps["camera_calibration"].measures
    assert calibrated["hand_eye_arm_corrected"] == 1.0
    assert calibrated["hand_eye_held_out_mm"] < 0.7 * calibrated["hand_eye_uncorrected_held_out_mm"]
    assert np.isfinite(calibrated["hand_eye_sigma_mm"])
