"""Somebody pushes the arm, or changes its tool at the pendant, in mid-run: asked by name, and no pose is wrong."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from service.core.arms import arm_model, flange_pose, pose_gap
from service.core.records.run_events import ViewpointCaptured
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.arms.arm_watch import ArmWatch
from tests.support.arms.ur_simulator import pendant
from tests.support.runs.one_arm_run import VIEWS, OneArmRun, arm_at, looks_for

pytestmark = [pytest.mark.timeout(300)]

PUSH = "push 0 0 0.05 0 0 0 0.1"
TCP = "tcp 0 0 0.1 0 0 0"
SPEED_UP = ("--speed-up", "3")


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store.open(tmp_path / "data") as opened:
        yield opened


def do(act: Callable[[], None], run: OneArmRun, arm: ArmWatch, moment: str) -> None:
    """Act once: while the second view is exposed, or once the arm was seen on the way to it."""
    shutter = run.station.shutter
    exposed: list[int] = []  # marks of the watch
    done: list[str] = []

    def once() -> None:
        if not done:
            done.append(moment)
            act()

    def captured(number: int) -> None:
        exposed.append(arm.mark())
        if moment == "exposing" and number == 2:
            once()

    def attend(_: object) -> None:
        under_way = len(exposed) == 1 and any(seen.speed_rad_s > 0.2 for seen in arm.samples()[exposed[0] :])
        if moment == "in motion" and under_way:
            once()

    shutter.on_capture = captured
    run.operator.on_attend = attend


def assert_true_poses(run: OneArmRun, arm: ArmWatch) -> None:
    """The recorded pose and joints of each view in force are those that the arm had."""
    for view in in_force(run):
        was = np.array(arm.joints_at(view.controller_time_s))
        assert np.allclose(view.joints_rad, was, atol=1e-4)
        away_m, away_rad = pose_gap(flange_pose(arm_model("UR10e"), was), np.array(view.T_base_flange))
        assert away_m < 1e-4, f"{view.viewpoint}: {1e3 * away_m:.1f} mm"
        assert away_rad < 1e-4
        assert np.allclose(view.T_flange_tcp or (), np.eye(4), atol=1e-6)
        assert view.payload_kg == pytest.approx(1.6)
        assert view.payload_centre_m == pytest.approx((0.0, 0.0, 0.08))


def in_force(run: OneArmRun) -> list[ViewpointCaptured]:
    return list({view.viewpoint: view for view in run.views()}.values())


@pytest.mark.slow
@pytest.mark.parametrize("moment", [pytest.param("in motion", marks=pytest.mark.sweep), "exposing"])
def test_an_arm_that_was_pushed_is_asked_about(tmp_path: Path, store: Store, moment: str) -> None:
    with arm_at(88, *SPEED_UP) as (host, arm):
        run = OneArmRun(store, tmp_path, host, arm)
        do(lambda: pendant(host, PUSH), run, arm, moment)
        run.answers(looks_for(0.2, arm, "joint 3 of robot stands 0.050 rad from where it was sent"))
        assert run.drive().status == "completed"
        assert run.failures() == ["ArmDepartedError"]
        assert [view.viewpoint for view in in_force(run)] == VIEWS
        assert_true_poses(run, arm)
    assert all(view.verdicts["still"] for view in in_force(run))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("act", "moment", "words"),
    [
        pytest.param(
            *(TCP, "in motion", "the tool centre point was changed by 100.0 mm and 0.0°"), marks=pytest.mark.sweep
        ),
        (TCP, "exposing", "the tool centre point was changed by 100.0 mm and 0.0°"),
        pytest.param(
            *("payload 3 0 0 0.08", "exposing", "the payload was changed from 1.6 kg to 3 kg"),
            marks=pytest.mark.sweep,
        ),
    ],
)
def test_a_tool_that_was_changed_is_asked_about_and_set_again(
    tmp_path: Path, store: Store, act: str, moment: str, words: str
) -> None:
    """Each later pose was wrong by as much, with all verdicts true."""
    with arm_at(89, *SPEED_UP) as (host, arm):
        run = OneArmRun(store, tmp_path, host, arm)
        do(lambda: pendant(host, act), run, arm, moment)
        run.answers(looks_for(0.2, arm, words))
        assert run.drive().status == "completed"
        assert run.failures() == ["ToolChangedError"]
        assert run.captured() == VIEWS
        assert_true_poses(run, arm)
    report = verify(tmp_path / "data", run.run_id)
    assert report.ok, report.first_fault
