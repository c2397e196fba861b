"""A turntable beside an arm: each takes photographs of one run, from doctor to registration and evaluation."""

from __future__ import annotations

import json
from collections.abc import Generator
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from service.cli.main import app
from service.core.geometry import inverse
from service.core.records.run_events import ViewpointCaptured
from tests.support.arms.grbl_simulator import CENTRE_M, TURN, mount, table
from tests.support.protocols.one_side import VIEWS, one_side
from tests.support.rig.patience import PATIENT_GRBL
from tests.support.rig.rig import orthocapture, simulated_rig
from tests.support.runs.ended_run import EndedRun, ended_run

HOST = "127.0.0.59"
TURNED, CONTROL = 5, 4  # views of the turntable
STAND: dict[str, Any] = {
    "id": "to_the_stand",
    "kind": "checklist",
    "title": "Put the camera on its stand",
    "checklist": ["The camera stands before the turntable"],
    "gates": [{"measure": "checklist_items_open", "max": 0, "unit": "items"}],
    "simulated_hands": [{"action": "hold_camera"}],
}


def protocol(path: Path) -> Path:
    """The arm takes the first photographs and those of the board, the turntable the others."""
    document = one_side("spheres")
    by_id = {step["id"]: step for step in document["steps"]}
    arm, control, registration = (
        by_id[name] for name in ("viewpoint_capture_1", "control_capture_1", "registration")
    )
    turned: dict[str, Any] = {**deepcopy(arm), "id": "around", "title": "Photographs from all sides"}
    captures: tuple[tuple[dict[str, Any], str, int], ...] = ((turned, "t", TURNED), (control, "c", 4))
    for step, prefix, count in captures:
        arc = {"tilt_deg": 35, "azimuth_from_deg": 20, "azimuth_to_deg": 310, "count": count, "distance_m": 0.62}
        step["params"]["viewpoints"] = [{"station": "table", "prefix": prefix, "image_top": "up", "arcs": [arc]}]
        step["gates"][0]["min"] = count
    registration["params"]["images_of"].append("around")
    at = document["steps"].index(control)
    document["steps"][at:at] = [STAND, turned]
    path.write_text(yaml.safe_dump(document, sort_keys=False, allow_unicode=True), encoding="utf-8")
    return path


def add_table(rig: Path, port: str) -> None:
    """Add the turntable to a rig file with an arm, which the planner knows as a UR10e."""
    record = yaml.safe_load(rig.read_text(encoding="utf-8"))
    assert record["collision"]["arm"] == "UR10e"
    record["devices"]["turntable"] = {
        "driver": "grbl", "port": port, "axes": [TURN.model_dump(mode="json", exclude_none=True)],
        "T_base_flange_zero": (mount() @ inverse(np.array(record["T_flange_camera_nominal"]))).tolist(),
        **PATIENT_GRBL,
    }  # fmt: skip
    record["stations"]["table"] = {
        "robot": "turntable", "scene_centre_m": CENTRE_M.tolist(), "approach_azimuth_deg": -90.0
    }  # fmt: skip
    rig.write_text(yaml.safe_dump(record, sort_keys=False), encoding="utf-8")


RIG = """\
name: an arm and a turntable
devices:
  robot: {driver: ur, host: 127.0.0.1}
stations:
  station_1: {robot: robot, scene_centre_m: [0.0, 0.8, 0.02], approach_azimuth_deg: -90}
T_flange_camera_nominal: [[1, 0, 0, 0.0], [0, 1, 0, 0.0], [0, 0, 1, 0.1], [0, 0, 0, 1]]
collision: {arm: UR10e}
"""


def test_motions_are_planned_of_the_arm_and_not_of_the_table(tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text(RIG, encoding="utf-8")
    add_table(rig, "table")
    words = ["plan", "show", str(protocol(tmp_path / "both.yaml")), "--rig", str(rig), "--json"]
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    plans = json.loads(done.stdout)
    assert [plan["station"] for plan in plans["viewpoint_capture_1"]] == ["station_1"]
    assert "around" not in plans


@dataclass(frozen=True)
class Run:
    """The run that the tests below share."""

    ended: EndedRun
    doctor: dict[str, Any]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Generator[Run]:
    folder = tmp_path_factory.mktemp("both")
    data, steps = folder / "data", protocol(folder / "both.yaml")
    options = ("--scene", "3", "--image-width", "960", "--speed-up", "10")
    with (
        simulated_rig(folder, *options, host=HOST) as rig,
        table(folder, "--world", rig["world"]) as port,
    ):
        add_table(Path(rig["rig"]), str(port))
        doctor = orthocapture("doctor", "--rig", rig["rig"], "--json")
        answer = orthocapture(
            "run", str(steps), "--rig", rig["rig"], "--data", str(data), "--operator", "Ada", "--auto-confirm",
            "--json", timeout_s=1100,
        )  # fmt: skip
    assert answer.returncode == 0, answer.stdout[-2000:] + answer.stderr[-3000:]
    with ended_run(data, Path(rig["truth"])) as ended:
        yield Run(ended, json.loads(doctor.stdout))


@pytest.mark.slow
@pytest.mark.whole
@pytest.mark.timeout(1200)
def test_both_take_every_view_of_one_run(run: Run) -> None:
    assert run.doctor["ok"]
    assert run.doctor["devices"]["turntable"]["identity"]["driver"] == "grbl"
    state = run.ended.summary.state
    assert state.status == "completed"
    captured = [e.payload for e in run.ended.summary.events if isinstance(e.payload, ViewpointCaptured)]
    axes = {one.viewpoint: (one.station, len(one.joints_rad)) for one in captured}
    assert [kind for name, kind in axes.items() if name.startswith("v1_")] == [("station_1", 6)] * VIEWS
    assert [kind for name, kind in axes.items() if name.startswith("t")] == [("table", 1)] * TURNED


@pytest.mark.slow
@pytest.mark.whole
@pytest.mark.timeout(1200)
def test_the_images_of_both_are_registered_together(run: Run) -> None:
    measures = run.ended.summary.state.steps["registration"].measures
    assert measures["spheres_images"] == VIEWS + TURNED + CONTROL
    (row,) = run.ended.summary.table()
    assert row.mean_radial_error_mm < 0.35
    assert run.ended.true_mm["spheres"] < 0.35
