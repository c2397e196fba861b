"""Fault plans name the nth message of a device, and refuse what they do not understand."""

from __future__ import annotations

from pathlib import Path

import pytest

from simulators.faults import FaultPlan
from simulators.serve import SimulatorError


def test_a_fault_is_due_at_its_message_and_for_as_often_as_planned() -> None:
    plan = FaultPlan.parse('[{"device": "camera", "on": "capture", "kind": "drop", "nth": 2, "times": 2}]')
    kinds = [fault.kind if (fault := plan.check("camera", "capture")) else None for _ in range(4)]
    assert kinds == [None, "drop", "drop", None]
    assert plan.check("robot", "capture") is None


def test_messages_are_counted_apart_and_a_star_counts_them_all() -> None:
    plan = FaultPlan.parse('[{"device": "robot", "on": "*", "kind": "stall", "nth": 3, "value": 1.5}]')
    assert plan.check("robot", "moveJ") is None
    assert plan.check("robot", "moveL") is None
    fault = plan.check("robot", "moveJ")
    assert fault is not None
    assert fault.value == 1.5


def test_a_plan_is_read_from_a_file_and_survives_its_own_json(tmp_path: Path) -> None:
    file = tmp_path / "plan.json"
    file.write_text('{"device": "ct", "on": "slice", "kind": "truncate"}')
    plan = FaultPlan.parse(str(file))
    assert FaultPlan.parse(plan.to_json()).faults == plan.faults
    assert FaultPlan.parse("").faults == ()


@pytest.mark.parametrize(
    ("text", "names"),
    [('[{"device": "ct", "on": "x"}]', "0.kind"), ("[{]", "JSON"), ("no/such/file", "no/such/file")],
)
def test_a_wrong_plan_is_refused_by_name(text: str, names: str) -> None:
    with pytest.raises(SimulatorError, match=names):
        FaultPlan.parse(text)
