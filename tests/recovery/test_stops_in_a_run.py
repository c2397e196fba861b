"""A run on a simulated arm over its real wires: after any stop of the arm, a person is asked before it moves on."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.core.records.run_events import DeviceTrouble, OperatorAction
from service.core.run.decide import AskOperator
from service.core.run.state import RunState
from service.store.store import Store
from tests.support.arms.arm_watch import ArmWatch, watched_arm
from tests.support.arms.ur_driver import dashboard
from tests.support.arms.ur_simulator import address, simulated_ur
from tests.support.processes.waiting import until
from tests.support.rig.bench_rig import answer
from tests.support.runs.one_arm_run import VIEWS, OneArmRun, arm_at, looks_for
from tests.support.vendor.ur_rtde_protocol import RtdeClient

pytestmark = [pytest.mark.timeout(300)]


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store.open(tmp_path / "data") as opened:
        yield opened


def stop_and_release(host: str, arm: ArmWatch) -> None:
    """Cause a stop of the arm and clear it on the pendant while nobody queries the robot."""
    client = RtdeClient(host)
    client.pause()
    client.close()
    until(lambda: unlock(host), "the stop is released")
    arm.pass_s(0.3)


def unlock(host: str) -> bool:
    return dashboard(host, "unlock protective stop")[0].startswith("Protective stop rel")


@pytest.mark.slow
def test_a_stop_during_an_exposure_is_asked_about_though_it_was_released(tmp_path: Path, store: Store) -> None:
    plan = '[{"device": "robot", "on": "rtde_P", "kind": "protective_stop"}]'
    with arm_at(80, "--speed-up", "3", "--faults", plan) as (host, arm):
        run = OneArmRun(store, tmp_path, host, arm)
        run.station.shutter.on_capture = lambda exposure: stop_and_release(host, arm) if exposure == 2 else None
        run.answers(looks_for(2.0, arm, "was in protective stop"))
        assert run.drive().status == "completed"
    assert run.failures() == ["SafetyStopError"]
    assert run.captured() == VIEWS, "what was taken is kept"


@pytest.mark.slow
def test_a_driver_killed_in_mid_motion_is_asked_about_before_the_arm_moves_on(tmp_path: Path, store: Store) -> None:
    with arm_at(81) as (host, arm):
        run = OneArmRun(store, tmp_path, host, arm)
        killed: list[int] = []

        def kill(_doing: str) -> None:
            if not killed and run.station.shutter.exposures >= 1 and arm.now.speed_rad_s > 0.2:
                killed.append(arm.mark())
                os.kill(run.station.driver_pid, signal.SIGKILL)

        run.operator.on_attend = kill
        run.answers(looks_for(3.0, arm, "died of SIGKILL; it was ended from outside"))
        assert run.drive().status == "completed"
        payloads = [event.payload for event in store.events(run.run_id)]
        (trouble,) = [p for p in payloads if isinstance(p, DeviceTrouble) and p.connection]
        assert trouble.connection == "died"
        assert "SIGKILL" in trouble.message
    assert killed
    assert run.failures() == ["DriverKilledError"]
    assert run.captured() == VIEWS


@pytest.mark.slow
def test_a_confirmation_from_before_the_stop_lets_nothing_move(tmp_path: Path, store: Store) -> None:
    """The stop comes after the person has confirmed and before the arm was told."""
    plan = '[{"device": "robot", "on": "rtde_P", "kind": "protective_stop"}]'
    with arm_at(82, "--speed-up", "3", "--faults", plan) as (host, arm):
        run = OneArmRun(store, tmp_path, host, arm)
        run.station.device("robot")  # it streams while the question is open
        run.operator.on_prepare = lambda: stop_and_release(host, arm)  # it is recorded, no step begun
        run.answers(looks_for(0.5, arm, "was in protective stop"))
        assert run.drive().status == "completed"
    assert run.failures() == ["SafetyStopError"]
    assert run.captured() == VIEWS


@pytest.mark.slow
def test_a_key_turned_to_remote_while_a_person_is_asked_is_seen(tmp_path: Path, store: Store) -> None:
    """The controller was in local control when it was connected."""
    host = address(83)
    with simulated_ur(host, "--speed-up", "3", "--local") as ready, watched_arm(host) as arm:
        run = OneArmRun(store, tmp_path, host, arm)

        def turn_key(question: AskOperator, _state: RunState) -> OperatorAction:
            assert "local control" in question.text
            os.kill(int(ready["pid"]), signal.SIGUSR1)
            until(lambda: dashboard(host, "is in remote control") == ["true"], "the key is not turned")
            return answer(question, "confirm")

        run.answers(turn_key)
        assert run.drive().status == "completed"
    assert run.failures() == ["DeviceRefusedError"]
    assert run.captured() == VIEWS
