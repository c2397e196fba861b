"""The programs that drive an arm are really killed or suspended: the arm stops, and moves on only for a person."""

from __future__ import annotations

import contextlib
import signal
import time
from collections.abc import Generator

import pytest

from drivers.ur import UrConfig
from tests.support.arms.arm_watch import ArmWatch, watched_arm
from tests.support.arms.stubborn import WATCHED_S, Program
from tests.support.arms.ur_simulator import address, simulated_ur
from tests.support.processes.waiting import until

pytestmark = pytest.mark.slow
AT_REST_WITHIN_S = 0.5
GOAL_RAD = 2.5


@contextlib.contextmanager
def moving(number: int, *, hangs: bool = False, unattended_s: float = 5.0) -> Generator[tuple[Program, ArmWatch]]:
    """An arm at full speed, and the program that drives it."""
    host = address(number)
    with simulated_ur(host), watched_arm(host) as arm:
        config = UrConfig(host=host, unattended_s=unattended_s)
        program = Program("drivers.ur:DRIVER", config, (GOAL_RAD, -GOAL_RAD), hangs=hangs)
        try:
            assert program.next("error")["error"] == "LeaveNeededError"
            assert arm.moved_for_s(1) == 0.0, "it does not move for nobody"
            program.let_move("Ada")
            arm.wait_moving(0.95)
            yield program, arm
        finally:
            program.close()


def comes_to_rest(arm: ArmWatch, since: int) -> float:
    """Wait and return how long the arm kept moving; it must stop and remain at rest."""
    time.sleep(WATCHED_S)
    assert arm.now.speed_rad_s == 0.0
    return arm.moved_for_s(since)


KILLED: dict[str, tuple[str, ...]] = {
    "the program": ("program",),
    "the driver": ("driver",),
    "both, the driver first": ("driver", "program"),
    "both, the program first": ("program", "driver"),
}


@pytest.mark.parametrize("victims", KILLED.values(), ids=KILLED)
def test_killed(victims: tuple[str, ...]) -> None:
    with moving(70) as (program, arm):
        since = arm.mark()
        program.send(*((victim, signal.SIGKILL) for victim in victims))
        went_on_s = comes_to_rest(arm, since)
        assert went_on_s <= AT_REST_WITHIN_S, f"{went_on_s:.3f} s, {arm.way_rad(since):.3f} rad"
        if victims == ("driver",):  # the program has reopened it and tries to continue
            assert program.next("error")["error"] == "DeviceUnavailableError"
            assert "since it was connected" in program.next("error")["message"]
            goes_on_for_a_person(program, arm)


def goes_on_for_a_person(program: Program, arm: ArmWatch) -> None:
    since = arm.mark()
    assert arm.moved_for_s(since) == 0.0
    program.let_move("Grace")
    arm.wait_moving(0.5)


@pytest.mark.parametrize("victim", ["program", "driver"])
def test_stopped_and_continued(victim: str) -> None:
    with moving(71) as (program, arm):
        since = arm.mark()
        program.send((victim, signal.SIGSTOP))
        went_on_s = comes_to_rest(arm, since)
        assert went_on_s <= AT_REST_WITHIN_S, f"{went_on_s:.3f} s, {arm.way_rad(since):.3f} rad"
        assert not arm.now.program_runs
        again = arm.mark()
        program.send((victim, signal.SIGCONT))
        error = program.next("error")
        assert error["error"] == "LeaveNeededError"
        assert "gave no sign of life" in error["message"]
        comes_to_rest(arm, again)
        assert arm.moved_for_s(again) == 0.0, "it moves on by itself"
        goes_on_for_a_person(program, arm)


def test_a_program_that_lives_but_no_longer_looks_at_its_moving_arm() -> None:
    with moving(72, hangs=True, unattended_s=0.8) as (_, arm):
        since = arm.mark()
        went_on_s = comes_to_rest(arm, since)
        assert went_on_s <= 0.8 + AT_REST_WITHIN_S, f"{went_on_s:.3f} s, {arm.way_rad(since):.3f} rad"
        assert arm.now.joint_rad < GOAL_RAD - 0.5, "it was stopped on its way"


def test_a_short_lapse_at_rest_needs_nobody() -> None:
    """A busy machine is no reason to ask: the script is sent again, since nothing moved and no stop was seen."""
    host = address(73)
    with simulated_ur(host), watched_arm(host) as arm:
        program = Program("drivers.ur:DRIVER", UrConfig(host=host), (GOAL_RAD, -GOAL_RAD))
        try:
            program.next("error")
            until(lambda: arm.now.program_runs, "it runs")
            program.send(("driver", signal.SIGSTOP))
            until(lambda: not arm.now.program_runs, "it ends", every_s=0.002)
            program.send(("driver", signal.SIGCONT))
            program.let_move("Ada")
            arm.wait_moving(0.5)
        finally:
            program.close()
