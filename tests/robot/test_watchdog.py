"""The programs that drive an arm are really killed or suspended: the arm stops, and moves on only for a person."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Generator

import psutil
import pytest

from drivers.ur import UrConfig
from tests.support.arms.arm_watch import ArmWatch, watched_arm
from tests.support.arms.stubborn import Program
from tests.support.arms.ur_simulator import address, simulated_ur
from tests.support.processes.lateness import Lateness
from tests.support.processes.waiting import until

pytestmark = [pytest.mark.realtime]
AT_REST_WITHIN_S = 0.5
LATE_TIMES = 5  # program, driver, its threads and the controller wake one after the other
STAYS_S = 1.0  # a program that is refused tries ten times
GOAL_RAD = 2.5


@contextlib.contextmanager
def moving(number: int, *, unattended_s: float = 5.0) -> Generator[tuple[Program, ArmWatch]]:
    """An arm at full speed, and the program that drives it."""
    host = address(number)
    with simulated_ur(host, patience_s=0), watched_arm(host) as arm:
        config = UrConfig(host=host, unattended_s=unattended_s)
        program = Program("drivers.ur:DRIVER", config, (GOAL_RAD, -GOAL_RAD))
        try:
            assert program.next("error")["error"] == "LeaveNeededError"
            assert arm.moved_for_s(1) == 0.0, "it does not move for nobody"
            program.go_on("Ada", lambda: arm.now.speed_rad_s >= 0.95)
            yield program, arm
        finally:
            program.close()


def comes_to_rest(arm: ArmWatch, since: int, lateness: Lateness, within_s: float = AT_REST_WITHIN_S) -> None:
    """Wait for the arm, which must stop in time and remain at rest."""
    arm.wait_stopped(since)
    went_on_s = arm.moved_for_s(since)
    limit_s = within_s + LATE_TIMES * lateness.worst_s
    assert went_on_s <= limit_s, f"{went_on_s:.3f} s instead of {limit_s:.3f} s, {arm.way_rad(since):.3f} rad"
    arm.pass_s(STAYS_S)
    assert arm.moved_for_s(since) == went_on_s, "it moves on by itself"


KILLED: dict[str, tuple[str, ...]] = {
    "the program": ("program",),
    "the driver": ("driver",),
    "both, the driver first": ("driver", "program"),
    "both, the program first": ("program", "driver"),
}


@pytest.mark.slow
@pytest.mark.parametrize("victims", KILLED.values(), ids=KILLED)
def test_killed(victims: tuple[str, ...]) -> None:
    with moving(70) as (program, arm), Lateness() as lateness:
        since = arm.mark()
        program.send(*((victim, signal.SIGKILL) for victim in victims))
        comes_to_rest(arm, since, lateness)
        rested = arm.mark()
        if victims == ("driver",):  # the program reopens it and tries to continue, again and again
            program.fails_with("DriverKilledError")
            assert "since it was connected" in program.fails_with("LeaveNeededError")["message"]
            arm.pass_s(STAYS_S)
            assert arm.moved_for_s(rested) == 0.0
            goes_on_for_a_person(program, arm)
        else:
            until(lambda: not psutil.pid_exists(program.driver), "the driver ends with its program")
            assert arm.moved_for_s(rested) == 0.0


def goes_on_for_a_person(program: Program, arm: ArmWatch) -> None:
    program.go_on("Grace", lambda: arm.now.speed_rad_s >= 0.5)


@pytest.mark.parametrize("victim", ["program", "driver"])
def test_stopped_and_continued(victim: str) -> None:
    with moving(71) as (program, arm), Lateness() as lateness:
        since = arm.mark()
        program.send((victim, signal.SIGSTOP))
        comes_to_rest(arm, since, lateness)
        again = arm.mark()
        program.send((victim, signal.SIGCONT))
        assert "gave no sign of life" in program.fails_with("LeaveNeededError")["message"]
        arm.pass_s(STAYS_S)  # in which the program tries again and again
        assert arm.moved_for_s(again) == 0.0, "it moves on by itself"
        goes_on_for_a_person(program, arm)


def test_a_program_that_lives_but_no_longer_looks_at_its_moving_arm() -> None:
    with moving(72, unattended_s=0.8) as (program, arm), Lateness() as lateness:
        since = arm.mark()
        program.hang()
        comes_to_rest(arm, since, lateness, 0.8 + AT_REST_WITHIN_S)
        assert arm.now.joints_rad[0] < GOAL_RAD - 0.5, "it was stopped on its way"


def test_a_short_lapse_at_rest_needs_nobody() -> None:
    """A busy machine is no reason to ask: the script is sent again, since nothing moved and no stop was seen."""
    host = address(73)
    with simulated_ur(host, patience_s=0), watched_arm(host) as arm:
        program = Program("drivers.ur:DRIVER", UrConfig(host=host), (GOAL_RAD, -GOAL_RAD))
        try:
            program.next("error")
            until(lambda: arm.now.program_runs, "it runs")
            since = arm.mark()
            program.send(("driver", signal.SIGSTOP))
            arm.wait_stopped(since)
            program.send(("driver", signal.SIGCONT))
            program.go_on("Ada", lambda: arm.now.speed_rad_s >= 0.5)
        finally:
            program.close()
