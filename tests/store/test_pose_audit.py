"""The audit compares the pose of each recorded view with the joints that were recorded with it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from service.core.arms import arm_model, flange_pose
from service.core.geometry import Transform, transform
from service.core.records.run_events import DeviceOpened
from service.store.records import NewArtefact
from service.store.store import Store
from service.store.verification.verify import AuditReport, verify
from tests.support.record.store import captured, put_image, start_run

JOINTS_RAD = (0.1, -1.2, 1.3, 0.0, 0.5, -0.0)
AWAY_M = 0.102
Record = Callable[[str, Sequence[tuple[str, float]]], AuditReport]


@pytest.fixture
def record(tmp_path: Path) -> Iterator[Record]:
    """Record a run whose robot is of a model, and views whose poses are so far off, in metres; verify it."""
    with Store.open(tmp_path / "data") as store:

        def recorded(model: str, views: Sequence[tuple[str, float]]) -> AuditReport:
            run_id = start_run(store)
            identity = {"kind": "robot", "model": model, "serial": "1"}
            store.record(run_id, [DeviceOpened(device="robot", report={"identity": identity})], actor="runner")
            for name, away_m in views:
                ref = put_image(store, name)
                view = captured(ref, name, T_base_flange=_rows(away_m), joints_rad=JOINTS_RAD)
                store.record(run_id, [view], actor="runner", artefacts=[NewArtefact(ref, "camera", "capture", 1)])
            return verify(tmp_path / "data", run_id)

        yield recorded


def _rows(away_m: float) -> tuple[tuple[float, ...], ...]:
    tool: Transform = transform(np.eye(3), np.array([0.0, 0.0, away_m]))
    return tuple(map(tuple, (flange_pose(arm_model("UR10e"), np.array(JOINTS_RAD)) @ tool).tolist()))


def test_a_view_whose_pose_its_joints_contradict_is_named_with_its_distance(record: Record) -> None:
    """The tool's centre point was changed in mid-run: gates passed and the audit verified."""
    report = record("UR10e", [("v001", 0.0), ("v002", AWAY_M), ("v003", 0.009)])
    assert [fault.what for fault in report.faults] == [
        "the pose of v002 is 102 mm and 0.0° from where its recorded joints put the flange: the tool at the "
        "controller was not the one reckoned with"
    ]
    assert report.faults[0].seq == 4
    assert not any("the pose of" in note for note in report.notes)


def test_a_view_that_was_taken_again_since_is_a_note(record: Record) -> None:
    report = record("UR10e", [("v001", AWAY_M), ("v001", 0.0)])
    assert report.ok
    assert [note for note in report.notes if "the pose of v001 is 102 mm" in note and "taken again since" in note]


@pytest.mark.parametrize("model", ["a bench arm", "LBR Med 14"])
def test_an_arm_that_cannot_be_judged_is_not(record: Record, model: str) -> None:
    report = record(model, [("v001", AWAY_M)])
    assert report.ok
    assert not any("the pose of" in note for note in report.notes)
