"""A viewpoint whose straight way is blocked: the arm goes through the joints of its detour, or not at all."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.core.geometry import Array
from service.core.records.run_events import OperatorAction, ViewpointFailed
from service.steps import motion
from service.steps.kinds import viewpoint_capture
from service.steps.viewpoints import Viewpoint, flange_target
from tests.support.runs.bench_run import PROTOCOL, VIEWS, Bench, begin_run, bench_store

BETWEEN_RAD = (np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]), np.array([0.2, 0.3, 0.4, 0.5, 0.6, 0.7]))


@pytest.fixture
def begin(tmp_path: Path) -> Iterator[Callable[[str], Bench]]:
    with bench_store(tmp_path / "data") as store:
        yield lambda text: begin_run(store, text, tmp_path)


def by_a_detour(monkeypatch: pytest.MonkeyPatch, name: str, begins_rad: Callable[[], Array]) -> None:
    """Let the plan reach this viewpoint through BETWEEN_RAD, from where `begins_rad` says."""

    def plan_step(*args: Any, **kwargs: Any) -> motion.StepPlan:
        plan = motion.plan_step(*args, **kwargs)
        way = np.stack([begins_rad(), *BETWEEN_RAD])
        viewpoints = tuple(replace(v, way_rad=way, from_rad=way[0]) if v.name == name else v for v in plan.viewpoints)
        return replace(plan, viewpoints=viewpoints)

    monkeypatch.setattr(viewpoint_capture, "plan_step", plan_step)


def sent(bench: Bench) -> list[Array]:
    """The joints to which the arm was sent, in order."""
    targets: list[Array] = []
    move = bench.rig.arm.move_joints

    def moved(target_rad: Array, **limits: Any) -> None:
        targets.append(target_rad)
        move(target_rad, **limits)

    bench.rig.arm.move_joints = moved  # type: ignore[method-assign]
    return targets


def test_the_arm_goes_through_the_joints_of_a_detour(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = begin(PROTOCOL)
    targets = sent(bench)
    by_a_detour(monkeypatch, VIEWS[0], lambda: bench.rig.arm.state().sample.joints_rad)
    assert bench.run().status == "completed"
    assert bench.captured() == VIEWS
    assert len(targets) == len(VIEWS) + len(BETWEEN_RAD)
    assert np.array_equal(targets[:2], BETWEEN_RAD)
    bench.must_verify()


def test_a_way_from_elsewhere_is_not_begun_but_planned_anew_from_where_the_arm_stands(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = begin(PROTOCOL)
    targets = sent(bench)
    planned: list[list[str]] = []

    def begins_rad() -> Array:
        return np.full(6, 2.0) if len(planned) == 1 else bench.rig.arm.state().sample.joints_rad

    by_a_detour(monkeypatch, VIEWS[1], begins_rad)
    detoured = viewpoint_capture.plan_step

    def plan_step(context: Any, viewpoints: Sequence[Viewpoint], *more: Any, **named: Any) -> motion.StepPlan:
        planned.append([viewpoint.name for viewpoint in viewpoints])
        return detoured(context, viewpoints, *more, **named)

    monkeypatch.setattr(viewpoint_capture, "plan_step", plan_step)
    assert bench.run().status == "completed"
    assert planned == [VIEWS, VIEWS[1:]]
    assert bench.captured() == VIEWS
    assert np.array_equal(targets[1:3], BETWEEN_RAD)
    assert bench.payloads(ViewpointFailed) == []


def test_a_viewpoint_that_is_taken_again_is_planned_from_where_the_arm_stands(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The arm once went back to it by a way that nobody had checked."""
    bench = begin(PROTOCOL)
    planned: list[list[str]] = []
    here: list[Array] = []

    def plan_step(context: Any, viewpoints: Sequence[Viewpoint], *more: Any, **named: Any) -> motion.StepPlan:
        """A plan as of an arm of known kinematics: each way begins where the one before it ends."""
        plan = motion.plan_step(context, viewpoints, *more, **named)
        planned.append([viewpoint.name for viewpoint in viewpoints])
        here[:] = [bench.rig.arm.state().sample.joints_rad]
        for viewpoint in viewpoints:
            target = flange_target(viewpoint.T_base_camera, bench.rig.nominal_T_flange_camera())
            here.append(bench.rig.arm.solve_ik(target, here[-1]))
        ways = zip(plan.viewpoints, here, here[1:], strict=False)
        viewpoints = tuple(replace(v, joints_rad=end, from_rad=start) for v, start, end in ways)
        return replace(plan, viewpoints=viewpoints)

    monkeypatch.setattr(viewpoint_capture, "plan_step", plan_step)
    looked = bench.operator.on_show

    def redo_the_first(what: str) -> None:
        redone = any(act.action == "redo" for act in bench.payloads(OperatorAction))
        if len(bench.captured()) == 2 and not redone:
            bench.act("redo", viewpoint=VIEWS[0], reason="a drape hung into it")
        looked(what)

    bench.operator.on_show = redo_the_first
    assert bench.run().status == "completed"
    assert bench.captured() == [*VIEWS, VIEWS[0]]
    assert planned == [VIEWS, [VIEWS[0]]]
