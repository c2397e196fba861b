"""A run on a simulated arm over its real wires: after any stop of the arm, a person is asked before it moves on."""

from __future__ import annotations

import contextlib
import json
import os
import signal
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.host.hosted_device import HostedDevice
from drivers.interfaces import Camera, Device, Lightbox
from service.core.protocol.models import parse_protocol
from service.core.records.events import DeviceTrouble, OperatorAction, StepFailed, ViewpointCaptured
from service.core.run.decide import AskOperator
from service.core.run.state import RunState
from service.rig import load_rig
from service.run_start import recorded_run, start_run
from service.runner.loop import Runner
from service.station import Station
from service.steps import params_models
from service.store.store import Store
from tests.support.arms.arm_watch import ArmWatch, watched_arm
from tests.support.arms.ur_driver import dashboard
from tests.support.arms.ur_simulator import address, simulated_ur
from tests.support.processes.waiting import until
from tests.support.rig.bench_rig import BenchCamera, ScriptedOperator, answer, numbered
from tests.support.rig.patience import PATIENT_UR
from tests.support.vendor.ur_rtde_protocol import RtdeClient

pytestmark = [pytest.mark.timeout(300)]

RIG = """\
name: one arm
simulated: true
devices:
  robot: {robot}
stations:
  station_1: {{robot: robot, scene_centre_m: [0.75, 0.0, -0.1], approach_azimuth_deg: 180}}
T_flange_camera_nominal: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.1], [0, 0, 0, 1]]
collision: {{arm: not in the table}}
"""
PROTOCOL = """\
id: stops
version: "1"
title: Views of one arm
spheres: {radius_mm: 15, registration: 10, control: 3}
board: {columns: 4, rows: 5, square_mm: 15}
camera: {aperture_f: 22, exposure_s: 1/50, iso: 100}
motion: {speed_rad_s: 0.8, acceleration_rad_s2: 1.5, dwell_s: 0.0}
settle: {window_s: 0.1, timeout_s: 5}
steps:
  - id: capture
    kind: viewpoint_capture
    title: Capture
    params:
      purpose: dataset
      viewpoints:
        - station: station_1
          prefix: v
          arcs: [{tilt_deg: 20, azimuth_from_deg: -40, azimuth_to_deg: 40, count: 3, distance_m: 0.5}]
    recovery: {retries: 2, wait_s: 0}
"""
VIEWS = ["v001", "v002", "v003"]


def slowly(arm: ArmWatch) -> Callable[[int], NDArray[np.uint8]]:
    """Pictures that take as long as real ones, so that samples of the arm arrive meanwhile."""

    def picture(number: int) -> NDArray[np.uint8]:
        arm.pass_s(0.5)
        return numbered(number)

    return picture


class OneArm(Station):
    """A station with the real driver for its arm and an in-memory camera."""

    def __init__(self, folder: Path, host: str, arm: ArmWatch) -> None:
        path = folder / "rig.yaml"
        robot = {"driver": "ur", "host": host, **PATIENT_UR}
        path.write_text(RIG.format(robot=json.dumps(robot)))
        super().__init__(load_rig(path))
        self.shutter = BenchCamera(picture=slowly(arm))
        self.shutter.open()

    def camera(self) -> Camera:
        return self.shutter

    def reopen(self, device: Device) -> None:
        if device is self.shutter:
            self.shutter.open()
        else:
            super().reopen(device)

    def lightbox(self) -> Lightbox | None:
        return None

    @property
    def driver_pid(self) -> int:
        device: HostedDevice = vars(self.device("robot"))["hosted_device"]
        assert device.pid is not None
        return device.pid


class Run:
    """A run on it, with a person who answers its questions."""

    def __init__(self, store: Store, folder: Path, host: str, arm: ArmWatch) -> None:
        self.station = OneArm(folder, host, arm)
        loaded = parse_protocol(PROTOCOL.encode(), params_models(), name="stops.yaml")
        self.store = store
        self.run_id = start_run(store, loaded, self.station.rig, operator="Ada", auto_confirm=False)
        self.operator = ScriptedOperator()

    def drive(self) -> RunState:
        protocol, _ = recorded_run(self.store, self.run_id)
        try:
            return Runner(self.store, self.run_id, protocol, self.station, self.operator).run()
        finally:
            self.station.close()

    def captured(self) -> list[str]:
        events = self.store.events(self.run_id)
        return [e.payload.viewpoint for e in events if isinstance(e.payload, ViewpointCaptured)]

    def failures(self) -> list[str]:
        return [e.payload.error for e in self.store.events(self.run_id) if isinstance(e.payload, StepFailed)]

    def answers(self, *answers: Callable[[AskOperator, RunState], OperatorAction | None]) -> None:
        self.operator.script = {("capture", "recovery"): list(answers)}


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store.open(tmp_path / "data") as opened:
        yield opened


@contextlib.contextmanager
def arm_at(number: int, *options: str) -> Generator[tuple[str, ArmWatch]]:
    host = address(number)
    with simulated_ur(host, *options), watched_arm(host) as arm:
        yield host, arm


def looks_for(seconds: float, arm: ArmWatch, words: str) -> Callable[[AskOperator, RunState], OperatorAction | None]:
    """Leave the question open for some time of the controller, in which nothing may move, then confirm."""
    began: list[int] = []

    def look(question: AskOperator, _state: RunState) -> OperatorAction | None:
        if not began:
            arm.wait_resting()
            began.append(arm.mark())
        assert words in question.text
        arm.pass_s(seconds)
        assert arm.moved_for_s(began[0]) == 0.0, "the arm moves while a person is asked"
        return answer(question, "confirm")

    return look


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
        run = Run(store, tmp_path, host, arm)
        run.station.shutter.on_capture = lambda exposure: stop_and_release(host, arm) if exposure == 2 else None
        run.answers(looks_for(2.0, arm, "was in protective stop"))
        assert run.drive().status == "completed"
    assert run.failures() == ["SafetyStopError"]
    assert run.captured() == VIEWS, "what was taken is kept"


@pytest.mark.slow
def test_a_driver_killed_in_mid_motion_is_asked_about_before_the_arm_moves_on(tmp_path: Path, store: Store) -> None:
    with arm_at(81) as (host, arm):
        run = Run(store, tmp_path, host, arm)
        killed: list[int] = []

        def kill(_doing: str) -> None:
            if not killed and run.station.shutter.exposures >= 1 and arm.now.speed_rad_s > 0.2:
                killed.append(arm.mark())
                os.kill(run.station.driver_pid, signal.SIGKILL)

        run.operator.on_attend = kill
        run.answers(looks_for(3.0, arm, "nobody has let the arm move since it was connected"))
        assert run.drive().status == "completed"
        payloads = [event.payload for event in store.events(run.run_id)]
        (trouble,) = [p for p in payloads if isinstance(p, DeviceTrouble) and p.connection]
        assert trouble.connection == "died"
        assert "SIGKILL" in trouble.message
    assert killed
    assert run.failures() == ["LeaveNeededError"]
    assert run.captured() == VIEWS


@pytest.mark.slow
def test_a_confirmation_from_before_the_stop_lets_nothing_move(tmp_path: Path, store: Store) -> None:
    """The stop comes after the person has confirmed and before the arm was told."""
    plan = '[{"device": "robot", "on": "rtde_P", "kind": "protective_stop"}]'
    with arm_at(82, "--speed-up", "3", "--faults", plan) as (host, arm):
        run = Run(store, tmp_path, host, arm)
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
        run = Run(store, tmp_path, host, arm)

        def turn_key(question: AskOperator, _state: RunState) -> OperatorAction:
            assert "local control" in question.text
            os.kill(int(ready["pid"]), signal.SIGUSR1)
            until(lambda: dashboard(host, "is in remote control") == ["true"], "the key is not turned")
            return answer(question, "confirm")

        run.answers(turn_key)
        assert run.drive().status == "completed"
    assert run.failures() == ["DeviceRefusedError"]
    assert run.captured() == VIEWS
