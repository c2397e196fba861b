"""A run with the real driver on a simulated arm over its real wires, an in-memory camera, and a scripted person."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Generator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.host.hosted_device import HostedDevice
from drivers.interfaces import Camera, Device, Lightbox, RobotArm
from service.core.protocol import parse_protocol
from service.core.records.run_events import OperatorAction, StepFailed, ViewpointCaptured
from service.core.run.decide import AskOperator
from service.core.run.state import RunState
from service.rig import load_rig
from service.run_start import recorded_run, start_run
from service.runner.loop import Runner
from service.station import Station
from service.steps import params_models
from service.store.store import Store
from tests.support.arms.arm_watch import ArmWatch, watched_arm
from tests.support.arms.ur_simulator import address, simulated_ur
from tests.support.rig.bench_rig import BenchCamera, ScriptedOperator, answer, numbered
from tests.support.rig.patience import PATIENT_UR

RIG = """\
name: one arm
simulated: true
devices:
  robot: {robot}
stations:
  station_1: {{robot: robot, scene_centre_m: [0.75, 0.0, -0.1], approach_azimuth_deg: 180}}
T_flange_camera_nominal: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.1], [0, 0, 0, 1]]
collision: {{arm: not in the table}}
payload: {{mass_kg: 1.6, centre_of_gravity_m: [0.0, 0.0, 0.08]}}
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
    gates: [{measure: moved_during_exposure, max: 0}]
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
        self.on_robot: Callable[[], None] = lambda: None  # called when a step takes the open arm, as before a motion

    def robot(self, station: str) -> RobotArm:
        arm = super().robot(station)
        self.on_robot()
        return arm

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


class OneArmRun:
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

    def views(self) -> list[ViewpointCaptured]:
        events = self.store.events(self.run_id)
        return [e.payload for e in events if isinstance(e.payload, ViewpointCaptured)]

    def captured(self) -> list[str]:
        return [view.viewpoint for view in self.views()]

    def failures(self) -> list[str]:
        return [e.payload.error for e in self.store.events(self.run_id) if isinstance(e.payload, StepFailed)]

    def answers(self, *answers: Callable[[AskOperator, RunState], OperatorAction | None]) -> None:
        self.operator.script = {("capture", "recovery"): list(answers)}


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
