"""A whole small run with a simulated Canon EOS R5, from doctor to the evaluation."""

from __future__ import annotations

import json
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from service.core.records.events import ViewpointCaptured
from tests.support.protocols.small_demo import VIEWS, small_demo
from tests.support.rig.rig import orthocapture, simulated_rig
from tests.support.runs.ended_run import EndedRun, ended_run, patient

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]


@dataclass(frozen=True)
class Run:
    """The run that the tests of this file share."""

    ended: EndedRun
    doctor: dict[str, Any]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Generator[Run]:
    folder = tmp_path_factory.mktemp("canon")
    data = folder / "data"
    options = ("--scene", "7", "--image-width", "960", "--ct-voxel-mm", "1.0", "--speed-up", "10")
    with simulated_rig(folder, *options, "--camera", "Canon EOS R5", host="127.0.0.46") as rig:
        patient(Path(rig["rig"]), watchdog_s=1.0)
        doctor = orthocapture("doctor", "--rig", rig["rig"], "--json")
        answer = orthocapture(
            "run", str(small_demo(folder / "small.yaml")), "--rig", rig["rig"], "--data", str(data),
            "--operator", "Ada", "--auto-confirm", "--json", timeout_s=1100,
        )  # fmt: skip
    assert answer.returncode == 0, answer.stdout[-2000:] + answer.stderr[-3000:]
    with ended_run(data, Path(rig["truth"])) as ended:
        yield Run(ended, json.loads(doctor.stdout))


def test_doctor_finds_the_camera_ready(run: Run) -> None:
    camera = run.doctor["devices"]["camera"]
    assert (camera["ok"], camera["identity"]["model"]) == (True, "Canon EOS R5")


def test_it_comes_to_its_end_with_every_view(run: Run) -> None:
    state = run.ended.summary.state
    assert state.status == "completed"
    assert not any(step.skipped_viewpoints for step in state.steps.values())
    captured = [e.payload for e in run.ended.summary.events if isinstance(e.payload, ViewpointCaptured)]
    assert len({one.viewpoint for one in captured if one.viewpoint.startswith("v")}) == VIEWS
    assert {one.camera["lens"] for one in captured} == {"RF24-70mm F2.8 L IS USM"}
    assert all(one.verdicts["settings"] for one in captured)


def test_its_errors_are_those_of_a_good_data_set(run: Run) -> None:
    rows = {row.poses: row for row in run.ended.summary.table()}
    assert rows["robot_corrected"].mean_radial_error_mm < 0.35
    assert run.ended.true_mm["robot_corrected"] < 0.35
