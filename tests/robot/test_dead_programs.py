"""Programs and drivers of a KUKA arm and of axes under GRBL are killed or suspended: these stop, and wait."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Generator
from pathlib import Path

import psutil
import pytest
from pydantic import BaseModel

from drivers.grbl import GrblConfig
from drivers.kuka import KukaConfig
from tests.support.arms.grbl_simulator import TURN, grbl_config, table
from tests.support.arms.kuka_simulator import simulated_kuka
from tests.support.arms.stubborn import Program
from tests.support.arms.ur_simulator import address
from tests.support.processes.lateness import Lateness
from tests.support.processes.waiting import until
from tests.support.rig.world_watch import WorldWatch, watched_world

pytestmark = [pytest.mark.realtime]
LATE_TIMES = 5  # program, driver, its threads and the controller wake one after the other
FULL_SPEED_AFTER_S = 0.9  # at 1.5 rad/s² to 1 rad/s


@contextlib.contextmanager
def kuka(folder: Path, world: str) -> Generator[BaseModel]:
    del folder
    host = address(78)
    with simulated_kuka(host, "--world", world, patience_s=0):
        yield KukaConfig(host=host)


@contextlib.contextmanager
def grbl(folder: Path, world: str) -> Generator[BaseModel]:
    with table(folder, "--world", world) as port:
        yield grbl_config(port, TURN)


Rig = Callable[[Path, str], contextlib.AbstractContextManager[BaseModel]]
RIGS: dict[str, tuple[Rig, str, tuple[float, float]]] = {
    "kuka": (kuka, "drivers.kuka:DRIVER", (2.5, -2.5)),
    "grbl": (grbl, "drivers.grbl:DRIVER", (-12.0, -0.2)),
}
AT_REST_WITHIN_S: dict[str, float] = {
    "kuka": KukaConfig.model_fields["rest_within_s"].default,
    "grbl": GrblConfig.model_fields["rest_within_s"].default,
}


@contextlib.contextmanager
def moving(name: str, folder: Path) -> Generator[tuple[Program, WorldWatch]]:
    """A device at full speed, and the program that drives it."""
    rig, spec, goals_rad = RIGS[name]
    with watched_world() as watch, rig(folder, watch.address) as config:
        program = Program(spec, config, goals_rad)
        try:
            assert program.next("error")["error"] == "LeaveNeededError"
            assert watch.moved_for_s(watch.mark()) == 0.0, "it does not move for nobody"
            begun_s = watch.mark()
            program.go_on("Ada", lambda: watch.moved_for_s(begun_s) >= FULL_SPEED_AFTER_S)
            yield program, watch
        finally:
            program.close()


def comes_to_rest(name: str, watch: WorldWatch, since_s: float, lateness: Lateness) -> None:
    """Wait for the device, which must stop in time."""
    watch.wait_resting(since_s)
    went_on_s = watch.moved_for_s(since_s)
    limit_s = AT_REST_WITHIN_S[name] + LATE_TIMES * lateness.worst_s
    assert went_on_s <= limit_s, f"{went_on_s:.3f} s instead of {limit_s:.3f} s"


@pytest.mark.slow
@pytest.mark.parametrize("victim", ["program", "driver"])
@pytest.mark.parametrize("name", RIGS)
def test_killed(name: str, victim: str, tmp_path: Path) -> None:
    with moving(name, tmp_path) as (program, watch), Lateness() as lateness:
        since_s = watch.mark()
        program.send((victim, signal.SIGKILL))
        comes_to_rest(name, watch, since_s, lateness)
        rested_s = watch.mark()
        if victim == "driver":  # the program reopens it and tries to continue, again and again
            program.fails_with("DriverKilledError")
            program.fails_with("LeaveNeededError")
            stays(watch, rested_s)
            goes_on_for_a_person(program, watch)
        else:
            until(lambda: not psutil.pid_exists(program.driver), "the driver ends with its program")
            stays(watch, rested_s)


@pytest.mark.parametrize("victim", ["program", "driver"])
@pytest.mark.parametrize("name", RIGS)
def test_stopped_and_continued(name: str, victim: str, tmp_path: Path) -> None:
    with moving(name, tmp_path) as (program, watch), Lateness() as lateness:
        since_s = watch.mark()
        program.send((victim, signal.SIGSTOP))
        comes_to_rest(name, watch, since_s, lateness)
        again_s = watch.mark()
        program.send((victim, signal.SIGCONT))
        program.fails_with("LeaveNeededError")  # at first its stream is old
        stays(watch, again_s)
        goes_on_for_a_person(program, watch)


def stays(watch: WorldWatch, since_s: float) -> None:
    """Nothing moves while a program that is refused tries some times more."""
    watch.wait_resting(watch.mark())
    assert watch.moved_for_s(since_s) == 0.0, "it moves on by itself"


def goes_on_for_a_person(program: Program, watch: WorldWatch) -> None:
    since_s = watch.mark()
    program.go_on("Grace", lambda: watch.moved_for_s(since_s) >= 0.5)
