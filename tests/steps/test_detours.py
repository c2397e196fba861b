"""A viewpoint whose straight way is blocked: the arm goes through the joints of its detour, or not at all."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.core.geometry import Array
from service.core.records.events import ViewpointFailed
from service.steps.capture.plan import planning
from service.steps.kinds.captures import viewpoint_capture
from tests.support.rig.bench_rig import answer
from tests.support.runs.bench_run import PROTOCOL, VIEWS, Bench, begin_run, bench_store

BETWEEN_RAD = (np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]), np.array([0.2, 0.3, 0.4, 0.5, 0.6, 0.7]))


@pytest.fixture
def begin(tmp_path: Path) -> Iterator[Callable[[str], Bench]]:
    with bench_store(tmp_path / "data") as store:
        yield lambda text: begin_run(store, text, tmp_path)


def by_a_detour(monkeypatch: pytest.MonkeyPatch, name: str, begins_rad: Callable[[], Array]) -> None:
    """Let the plan reach this viewpoint through BETWEEN_RAD, from where `begins_rad` says."""

    def plan_step(*args: Any, **kwargs: Any) -> planning.StepPlan:
        plan = planning.plan_step(*args, **kwargs)
        way = np.stack([begins_rad(), *BETWEEN_RAD])
        viewpoints = tuple(replace(v, way_rad=way) if v.name == name else v for v in plan.viewpoints)
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


def test_a_detour_from_elsewhere_is_not_begun_and_the_viewpoint_is_taken_when_planned_anew(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = begin(PROTOCOL.replace("min: 3}", "min: 4}"))
    targets = sent(bench)
    by_a_detour(monkeypatch, VIEWS[1], lambda: np.full(6, 2.0))

    def again(question: Any, _state: Any) -> Any:
        assert len(targets) == len(VIEWS) - 1
        by_a_detour(monkeypatch, VIEWS[1], lambda: bench.rig.arm.state().sample.joints_rad)
        return answer(question, "confirm")

    bench.script("capture", "recovery", again)
    assert bench.run().status == "completed"
    (failed,) = bench.payloads(ViewpointFailed)
    assert "its detour was planned from elsewhere" in failed.message
    assert sorted(bench.captured()) == VIEWS
    assert np.array_equal(targets[-3:-1], BETWEEN_RAD)
