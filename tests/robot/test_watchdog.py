"""The programs that drive an arm are really killed or suspended: the arm stops, and moves on only for a person."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Generator
from typing import Any

import pytest

from tests.support.processes.stubborn_program import GOAL_RAD
from tests.support.processes.waiting import until
from tests.support.rig.arm_watch import ArmWatch, watched_arm
from tests.support.rig.ur_simulator import address, simulated_ur

pytestmark = pytest.mark.slow
AT_REST_WITHIN_S = 0.5
WATCHED_S = 4.0  # an arm that moved by itself did so after 2.3 s


class Program:
    """tests.support.processes.stubborn_program as a process."""

    def __init__(self, host: str, *, hangs: bool, unattended_s: float) -> None:
        how = "hangs" if hangs else "lives"
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.support.processes.stubborn_program", host, how, str(unattended_s)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        self._lines: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self.driver = int(self.next("driver")["driver"])

    @property
    def pid(self) -> int:
        return self._process.pid

    def let_move(self, person: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(person + "\n")
        self._process.stdin.flush()
        assert self.next("let_by")["let_by"] == person

    def next(self, key: str, within_s: float = 30.0) -> dict[str, Any]:
        """The next line with this key."""
        deadline_s = time.monotonic() + within_s
        while True:
            line = self._lines.get(timeout=max(0.01, deadline_s - time.monotonic()))
            if key in line:
                return line

    def close(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.driver, signal.SIGCONT)
        self._process.kill()
        self._process.wait(10)
        self._reader.join(10)
        for pipe in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(OSError):
                if pipe is not None:
                    pipe.close()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._lines.put(json.loads(line))


@contextlib.contextmanager
def moving(number: int, *, hangs: bool = False, unattended_s: float = 5.0) -> Generator[tuple[Program, ArmWatch]]:
    """An arm at full speed, and the program that drives it."""
    host = address(number)
    with simulated_ur(host), watched_arm(host) as arm:
        program = Program(host, hangs=hangs, unattended_s=unattended_s)
        try:
            assert program.next("error")["error"] == "LeaveNeededError"
            assert arm.moved_for_s(1) == 0.0, "it does not move for nobody"
            program.let_move("Ada")
            arm.wait_moving(0.95)
            yield program, arm
        finally:
            program.close()


def send(program: Program, *signals: tuple[str, signal.Signals]) -> None:
    for to, which in signals:
        os.kill(program.driver if to == "driver" else program.pid, which)


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
        send(program, *((victim, signal.SIGKILL) for victim in victims))
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
        send(program, (victim, signal.SIGSTOP))
        went_on_s = comes_to_rest(arm, since)
        assert went_on_s <= AT_REST_WITHIN_S, f"{went_on_s:.3f} s, {arm.way_rad(since):.3f} rad"
        assert not arm.now.program_runs
        again = arm.mark()
        send(program, (victim, signal.SIGCONT))
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
        program = Program(host, hangs=False, unattended_s=5.0)
        try:
            program.next("error")
            until(lambda: arm.now.program_runs, "it runs")
            send(program, ("driver", signal.SIGSTOP))
            until(lambda: not arm.now.program_runs, "it ends", every_s=0.002)
            send(program, ("driver", signal.SIGCONT))
            program.let_move("Ada")
            arm.wait_moving(0.5)
        finally:
            program.close()
