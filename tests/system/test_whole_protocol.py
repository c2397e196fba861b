"""The paper's protocol as its user runs it: every step, every kind of view, a sixth of them, at a low resolution."""

from __future__ import annotations

import json
from collections.abc import Generator
from pathlib import Path

import pytest

from service.core.records.run_events import OperatorAction
from tests.support.protocols.shortened import shortened
from tests.support.rig.rig import REPOSITORY, orthocapture, simulated_rig
from tests.support.runs.ended_run import EndedRun, ended_run

pytestmark = [pytest.mark.slow, pytest.mark.whole, pytest.mark.timeout(1500)]
WIDTH, SLICE_MM = "960", 1.0


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Generator[EndedRun]:
    folder = tmp_path_factory.mktemp("whole")
    data = folder / "data"
    protocol = REPOSITORY / "protocols" / "exvivo_spine.yaml"
    short = shortened(protocol, 6, folder / "short.yaml", slice_mm=SLICE_MM, settle_s=1.0, chamfer_spacing_mm=0.4)
    options = ("--scene", "7", "--image-width", WIDTH, "--ct-voxel-mm", str(SLICE_MM), "--speed-up", "10")
    with simulated_rig(folder, *options, host="127.0.0.52") as rig:
        answer = orthocapture(
            "run", str(short), "--rig", rig["rig"], "--data", str(data), "--operator", "Ada", "--auto-confirm",
            "--json", timeout_s=1400,
        )  # fmt: skip
    assert answer.returncode == 0, answer.stdout[-2000:] + answer.stderr[-3000:]
    with ended_run(data, Path(rig["truth"])) as ended:
        yield ended


def test_it_comes_to_its_end_without_a_person(whole: EndedRun) -> None:
    state = whole.summary.state
    assert state.status == "completed"
    assert {step.phase for step in state.steps.values()} == {"passed"}
    assert not any(step.skipped or step.accepted for step in state.steps.values())
    actions = [e.payload for e in whole.summary.events if isinstance(e.payload, OperatorAction)]
    assert len(actions) >= len(state.steps)
    assert all(action.automatic for action in actions)
    assert {action.action for action in actions} <= {"confirm", "sign"}


def test_every_kind_of_view_is_there(whole: EndedRun) -> None:
    captured = {name: len(step.captured) for name, step in whole.summary.state.steps.items() if step.captured}
    assert captured["intrinsics"] >= 15
    assert captured["hand_eye"] >= 12
    assert [captured[f"{kind}_{n}"] >= least for n in (1, 2) for kind, least in _VIEWS] == [True] * 4
    kinds = {c.artefacts[0].kind for c in whole.summary.captures()}
    assert {"image", "control_image"} <= kinds


_VIEWS = (("viewpoint_capture", 8), ("control_capture", 2))


def test_errors_are_those_of_a_good_data_set(whole: EndedRun) -> None:
    rows = {row.poses: row for row in whole.summary.table()}
    assert {"robot", "robot_corrected", "triangulated", "colmap", "glomap", "hybrid"} <= set(rows)
    # The arm's errors remain; everything else is fitted to the images, which are small here.
    assert whole.true_mm["robot"] < 0.35
    for source in set(rows) - {"robot"}:
        assert rows[source].mean_radial_error_mm < 0.1
        assert whole.true_mm[source] < 0.1


def test_the_evidence_verifies(whole: EndedRun) -> None:
    answer = orthocapture("audit", "verify", "latest", "--data", str(whole.data), "--json", timeout_s=300)
    assert answer.returncode == 0, answer.stdout
    assert json.loads(answer.stdout)["ok"] is True
