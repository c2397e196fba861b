"""Smeared lens, covered board, blurred and black images over the camera's wire: noticed and mended without asking."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import pytest
import yaml

from service.core.records.run_events import OperatorAction, StepNote, StepRetried, ViewpointCaptured
from service.core.run.fold import fold
from service.core.run.state import RunState
from service.run_start import recorded_run
from service.store.store import Store
from tests.support.protocols.small_demo import COARSE, SLICE_MM
from tests.support.rig.rig import REPOSITORY, orthocapture, simulated_rig

pytestmark = [pytest.mark.timeout(600)]
BOARDS, VIEWS = 9, 5
T = TypeVar("T")


@dataclass(frozen=True)
class Ran:
    """What a run recorded and printed."""

    state: RunState
    payloads: Sequence[object]
    told: str

    def of(self, kind: type[T]) -> list[T]:
        return [payload for payload in self.payloads if isinstance(payload, kind)]

    def captured(self, step: str) -> list[str]:
        return [capture.viewpoint for capture in self.of(ViewpointCaptured) if capture.step == step]


def protocol(folder: Path, *wanted: str) -> Path:
    """Steps of demo.yaml, with board poses planned by the software and one arc of viewpoints."""
    document = yaml.safe_load((REPOSITORY / "protocols" / "demo.yaml").read_text())
    steps = {step["id"]: step for step in document["steps"]}
    calibration = steps["camera_calibration"]
    del calibration["params"]["viewpoints"]
    poses = {"station": "station_1", "prefix": "b", "count": BOARDS, "coverage": 0.8}
    calibration["params"]["board_poses"] = poses
    capture = steps["viewpoint_capture_1"]
    arc = {"tilt_deg": 25, "azimuth_from_deg": -40, "azimuth_to_deg": 40, "count": VIEWS, "distance_m": 0.64}
    capture["params"]["viewpoints"][0]["arcs"] = [arc]
    for step, measure, least in ((calibration, "views", BOARDS), (capture, "viewpoints_captured", VIEWS)):
        next(gate for gate in step["gates"] if gate["measure"] == measure)["min"] = least
    next(gate for gate in steps["ct_import"]["gates"] if gate["measure"] == "slice_spacing_mm")["max"] = SLICE_MM
    document["steps"] = [steps[name] for name in wanted]
    path = folder / "spoilt.yaml"
    path.write_text(yaml.safe_dump(document, sort_keys=False))
    return path


def run(folder: Path, faults: Sequence[Mapping[str, Any]], *wanted: str, host: str) -> Ran:
    """The run with --auto-confirm on a rig whose camera has these faults."""
    plan = json.dumps([{"device": "camera", "on": "image", **fault} for fault in faults])
    options = ("--scene", "3", "--image-width", "600", "--speed-up", "10", *COARSE, "--faults", plan)
    with simulated_rig(folder, *options, host=host) as rig:
        answer = orthocapture(
            "run", str(protocol(folder, *wanted)), "--rig", rig["rig"], "--data", str(folder / "data"), "--operator",
            "Ada", "--auto-confirm", timeout_s=560,
        )  # fmt: skip
    assert answer.returncode == 0, answer.stdout[-2000:] + answer.stderr[-3000:]
    with Store.open(folder / "data", create=False) as store:
        run_id = store.find_run("latest")
        events = store.events(run_id)
        state = fold(recorded_run(store, run_id)[0], events)
    ran = Ran(state, [event.payload for event in events], answer.stderr)
    assert state.status == "completed"
    assert all(action.automatic for action in ran.of(OperatorAction))
    return ran


@pytest.mark.slow
@pytest.mark.whole
def test_a_covered_board_a_blurred_and_a_black_image_are_taken_again_at_once(tmp_path: Path) -> None:
    first_view = BOARDS + 1 + 1  # one additional board image is taken
    faults = (
        {"kind": "covered", "nth": 4, "value": 0.5},
        {"kind": "blur", "nth": first_view + 1},
        {"kind": "black", "nth": first_view + 3},
    )
    steps = ("ct_hand_over_out", "ct_import", "camera_set_up", "camera_calibration", "board_removal",
             "viewpoint_capture_1")  # fmt: skip
    ran = run(tmp_path, faults, *steps, host="127.0.0.42")
    assert not ran.of(StepRetried)

    boards = ran.captured("camera_calibration")
    assert len(boards) == len(set(boards)) == BOARDS + 1, "another pose, not the covered one again"
    plans = [note.data for note in ran.of(StepNote) if note.note == "board_poses"]
    replaced = [plan for plan in plans if plan["why"] == "replacement"]
    assert [list(plan["instead_of"]) for plan in replaced] == [[boards[3]]]
    assert "board" in replaced[0]["instead_of"][boards[3]]
    assert f"{boards[3]}: not used" in ran.told

    views = ran.captured("viewpoint_capture_1")
    assert {name: n for name, n in Counter(views).items() if n > 1} == {views[1]: 2, views[3]: 2}
    assert sorted(views[VIEWS:]) == sorted([views[1], views[3]])
    assert ran.state.steps["viewpoint_capture_1"].measures["images_spoilt"] == 0
    assert f"{views[1]}: blurred" in ran.told
    assert f"{views[3]}: the image is black" in ran.told


@pytest.mark.slow
@pytest.mark.whole
def test_a_smeared_lens_is_cleaned_and_exactly_the_blurred_images_are_taken_again(tmp_path: Path) -> None:
    """Without a wire, it is in tests/steps/test_board_capture.py."""
    smeared_at = 7
    ran = run(
        tmp_path, ({"kind": "smear", "nth": smeared_at},), "camera_set_up", "camera_calibration", host="127.0.0.43"
    )
    (stop,) = [note.data for note in ran.of(StepNote) if note.note == "spoilt images"]
    assert stop["hands"] == [{"action": "clean_lens"}]
    assert "Clean the lens, then confirm" in stop["advice"]
    assert "Clean the lens, then confirm" in ran.told
    bad = list(stop["viewpoints"])
    boards = ran.captured("camera_calibration")
    assert boards[smeared_at - 1 : smeared_at - 1 + len(bad)] == bad
    again = [name for name, n in Counter(boards).items() if n > 1]
    assert sorted(again) == sorted(bad)
    assert len(boards) == BOARDS + len(bad)
    (retried,) = ran.of(StepRetried)
    assert retried.step == "camera_calibration"
    assert ran.state.steps["camera_calibration"].measures["views"] >= BOARDS
