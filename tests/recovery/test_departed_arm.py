"""An arm that does not stand where it was sent: no view is recorded, nothing moves from there, a person is asked."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from drivers.errors import ArmDepartedError
from drivers.interfaces import RobotState
from service.core.records.run_events import OperatorAction, StepFailed, ViewpointCaptured
from service.core.run.decide import AskOperator
from service.core.run.state import RunState
from service.steps.motion import STANDS_RAD, require_there
from tests.support.rig.bench_rig import answer
from tests.support.runs.bench_run import VIEWS, Bench

Push = Callable[[Bench], None]


def on_the_way(bench: Bench) -> None:
    """Push the arm while it drives to the second viewpoint."""

    def push(move: int) -> None:
        if move == 2:
            bench.rig.arm.push(0.4)

    bench.rig.arm.on_move = push


def after_a_photograph(bench: Bench) -> None:
    """Push the arm when the second photograph has been taken, before anybody looks at the arm again."""
    arm = bench.rig.arm
    state = arm.state

    def pushed() -> RobotState:
        if bench.rig.shutter.exposures == 2 and arm.moves == 2:
            arm.state = state
            arm.push(-0.4)
        return state()

    arm.state = pushed


@pytest.mark.parametrize("push", [on_the_way, after_a_photograph])
def test_nothing_moves_from_there_before_a_person_has_looked(bench: Bench, push: Push) -> None:
    """It was photographed there with all verdicts true, and the next motion began there."""
    asked_after: list[int] = []

    def confirm(question: AskOperator, _state: RunState) -> OperatorAction:
        assert "joint 3 of robot stands 0.400 rad from where it was sent" in question.text
        asked_after.append(bench.rig.arm.moves)
        return answer(question, "confirm")

    push(bench)
    bench.script("capture", "recovery", confirm)
    opened = bench.rig.arm.opened
    assert bench.run().status == "completed"
    assert asked_after == [2]
    assert [failed.error for failed in bench.payloads(StepFailed)] == ["ArmDepartedError"]
    assert bench.captured() == VIEWS
    assert bench.rig.arm.opened == opened + 2  # opened for the run, and anew: which revoked its leave to move
    for view in bench.payloads(ViewpointCaptured):
        assert view.verdicts["still"]


def test_a_fraction_of_a_degree_is_not_told() -> None:
    sent = np.zeros(6)
    require_there("robot", sent + STANDS_RAD, sent, step="capture")
    for joint in range(6):
        away = sent.copy()
        away[joint] = -1.01 * STANDS_RAD
        with pytest.raises(ArmDepartedError, match=f"joint {joint + 1} of robot"):
            require_there("robot", away, sent, step="capture")
