"""Programs and drivers of a KUKA arm and of axes under GRBL are killed or suspended: these stop, and wait."""

from __future__ import annotations

import contextlib
import signal
import time
from collections.abc import Callable, Generator
from pathlib import Path

import pytest
from pydantic import BaseModel

from drivers.kuka import KukaConfig
from tests.support.arms.grbl_simulator import TURN, grbl_config, table
from tests.support.arms.kuka_simulator import simulated_kuka
from tests.support.arms.stubborn import WATCHED_S, Program
from tests.support.arms.ur_simulator import address
from tests.support.rig.world_watch import WorldWatch, watched_world

pytestmark = pytest.mark.slow
AT_REST_WITHIN_S = 0.5


@contextlib.contextmanager
def kuka(folder: Path, world: str) -> Generator[BaseModel]:
    del folder
    host = address(78)
    with simulated_kuka(host, "--world", world):
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


@contextlib.contextmanager
def moving(name: str, folder: Path) -> Generator[tuple[Program, WorldWatch]]:
    """A device at full speed, and the program that drives it."""
    rig, spec, goals_rad = RIGS[name]
    with watched_world() as watch, rig(folder, watch.address) as config:
        program = Program(spec, config, goals_rad)
        try:
            assert program.next("error")["error"] == "LeaveNeededError"
            assert watch.moved_for_s(watch.mark()) == 0.0, "it does not move for nobody"
            program.let_move("Ada")
            program.next("moves_to")
            time.sleep(1.5)
            yield program, watch
        finally:
            program.close()


def comes_to_rest(watch: WorldWatch, since_s: float) -> float:
    """Wait and return how long it kept moving; it must stay at rest."""
    time.sleep(WATCHED_S)
    went_on_s = watch.moved_for_s(since_s)
    assert went_on_s < WATCHED_S - 1.0, "it moves on"
    return went_on_s


@pytest.mark.parametrize("victim", ["program", "driver"])
@pytest.mark.parametrize("name", RIGS)
def test_killed(name: str, victim: str, tmp_path: Path) -> None:
    with moving(name, tmp_path) as (program, watch):
        since_s = watch.mark()
        program.send((victim, signal.SIGKILL))
        went_on_s = comes_to_rest(watch, since_s)
        assert went_on_s <= AT_REST_WITHIN_S, f"{went_on_s:.3f} s"
        if victim == "driver":  # the program has reopened it and tries to continue
            assert program.next("error")["error"] == "DeviceUnavailableError"
            assert program.next("error")["error"] == "LeaveNeededError"
            goes_on_for_a_person(program, watch)


@pytest.mark.parametrize("victim", ["program", "driver"])
@pytest.mark.parametrize("name", RIGS)
def test_stopped_and_continued(name: str, victim: str, tmp_path: Path) -> None:
    with moving(name, tmp_path) as (program, watch):
        since_s = watch.mark()
        program.send((victim, signal.SIGSTOP))
        went_on_s = comes_to_rest(watch, since_s)
        assert went_on_s <= AT_REST_WITHIN_S, f"{went_on_s:.3f} s"
        again_s = watch.mark()
        program.send((victim, signal.SIGCONT))
        while program.next("error")["error"] != "LeaveNeededError":
            pass  # at first its stream is old
        comes_to_rest(watch, again_s)
        assert watch.moved_for_s(again_s) == 0.0, "it moves on by itself"
        goes_on_for_a_person(program, watch)


def goes_on_for_a_person(program: Program, watch: WorldWatch) -> None:
    program.let_move("Grace")
    program.next("moves_to")
    since_s = watch.mark()
    time.sleep(1.5)
    assert watch.moved_for_s(since_s) > 0.5
