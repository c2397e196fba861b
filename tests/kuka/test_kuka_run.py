"""A whole small run with two simulated KUKAs, one at each station, from doctor to the evaluation.

The camera is calibrated on both arms, because each has errors of its own. A hand scanner scans the control
spheres, and one of single views the whole scene.
"""

from __future__ import annotations

import json
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from service.computations.calibration import CALIBRATE, CalibrateAnswer
from service.core.records.run_events import JobEnqueued, ViewpointCaptured
from tests.support.protocols.small_demo import COARSE
from tests.support.protocols.two_arms import FIRST, SECOND, for_two_arms, kuka_demo
from tests.support.rig.rig import orthocapture, simulated_rig
from tests.support.runs.ended_run import EndedRun, ended_run

pytestmark = [pytest.mark.slow, pytest.mark.whole, pytest.mark.timeout(1200)]
ARM = "LBR Med 14"
SCANNER, PARTS = "zivid", 3  # views of it that are one scan


@dataclass(frozen=True)
class Run:
    """The run that the tests of this file share."""

    ended: EndedRun
    doctor: dict[str, Any]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Generator[Run]:
    folder = tmp_path_factory.mktemp("kuka")
    protocol, data = folder / "demo.yaml", folder / "data"
    record = kuka_demo(protocol)
    by_id = {step["id"]: step for step in record["steps"]}
    by_id["control_scan"]["params"]["device"] = "scanner"
    by_id["scanning"]["params"] |= {"device": SCANNER, "parts": PARTS}
    by_id["scanning"]["simulated_hands"] = [{"action": "hand_scan", "device": SCANNER}]
    by_id["scanning"]["gates"].append({"measure": "part_residual_max_mm", "max": 0.1, "unit": "mm"})
    record = for_two_arms(record, images=12)
    protocol.write_text(yaml.safe_dump(record, sort_keys=False, allow_unicode=True), encoding="utf-8")
    options = ("--scene", "7", "--image-width", "960", *COARSE, "--speed-up", "10", "--arm", ARM)
    two = ("--arms", "2", "--further-scanner", SCANNER)
    with simulated_rig(folder, *options, *two, host="127.0.0.44") as rig:
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
    carried = {one.viewpoint[:2]: one.station for one in captured}
    assert {carried[name] for name in ("v1", "c1")} == {"station_1"}
    assert {carried[name] for name in ("v2", "c2")} == {"station_2"}
    for name in ("robot_1", "robot_2"):
        robot = run.doctor["devices"][name]
        assert (robot["ok"], robot["identity"]["model"], robot["identity"]["driver"]) == (True, ARM, "kuka_sunrise")
    assert "Zivid" in run.doctor["devices"][SCANNER]["identity"]["model"]
    assert state.steps["scanning"].measures["scan_parts"] == PARTS


def test_its_errors_are_those_of_a_good_data_set(run: Run) -> None:
    rows = {row.poses: row for row in run.ended.summary.table()}
    assert set(rows) == {"robot", "robot_corrected"}
    assert run.ended.true_mm["robot"] < 1.0  # the arm's own error
    assert run.ended.true_mm["robot_corrected"] < 0.35
    assert rows["robot_corrected"].mean_radial_error_mm < rows["robot"].mean_radial_error_mm


def test_each_arm_has_a_correction_of_seven_joints_of_its_own(run: Run) -> None:
    steps = run.ended.summary.state.steps
    found: list[CalibrateAnswer] = []
    for name in (FIRST, SECOND):
        calibrated = steps[name].measures
        assert calibrated["hand_eye_arm_corrected"] == 1.0
        assert calibrated["hand_eye_held_out_mm"] < 0.7 * calibrated["hand_eye_uncorrected_held_out_mm"]
        assert np.isfinite(calibrated["hand_eye_sigma_mm"])
        found.append(CALIBRATE.read_answer(steps[name].result or {}))
    corrections = [one.hand_eye.arm_correction for one in found if one.hand_eye is not None]
    deltas = [np.array(one.dh_deltas) for one in corrections if one is not None]
    assert [one.shape for one in deltas] == [(7, 5), (7, 5)]
    assert not np.allclose(deltas[0], deltas[1])


def test_the_images_of_each_arm_are_placed_by_its_own_calibration(run: Run) -> None:
    events = run.ended.summary.events
    enqueued = [event.payload for event in events if isinstance(event.payload, JobEnqueued)]
    (search,) = (job for job in enqueued if job.job_kind == "detect_spheres")
    (further,) = search.arguments["further_arms"]
    assert search.arguments["arm_stations"] == ["station_1"]
    assert further["stations"] == ["station_2"]
    jobs = {job.job for job in enqueued if job.step == SECOND}
    assert further["T_flange_camera"]["$from"]["job"] in jobs
    assert further["arm_correction"]["$from"]["job"] in jobs
