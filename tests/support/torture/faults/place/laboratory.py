"""The small rig of a case: the real driver for the tested device, with an in-memory arm and camera."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from json import loads
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from drivers.interfaces import Camera, Device, RobotArm
from service.rig import load_rig
from service.station import Station
from service.steps.context import LeaveToMove, StationLayout
from simulators.__main__ import main as simulate
from tests.support.rig.bench_rig import BenchArm, BenchCamera, numbered

_STATION = {"robot": "robot", "scene_centre_m": [0.75, 0.0, -0.1], "approach_azimuth_deg": 180}
_BENCH = StationLayout("station_1", "robot", (0.0, 0.8, 0.0), (0.0, -1.0, 0.0))  # of the in-memory arm
VIEWS = ("v001", "v002", "v003")
PROTOCOL = """\
id: faults
version: "1"
title: A few views while something goes wrong
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
          arcs: [{tilt_deg: 20, azimuth_from_deg: -40, azimuth_to_deg: 40, count: 3, distance_m: DISTANCE}]
    gates:
      - {measure: viewpoints_captured, min: 3}
      - {measure: settings_departures, max: 0}
      - {measure: moved_during_exposure, max: 0}
    recovery: {retries: 1, wait_s: 0.2}
"""
TABLE = (
    PROTOCOL.replace("prefix: v\n", "prefix: v\n          image_top: up\n")
    .replace(
        "{tilt_deg: 20, azimuth_from_deg: -40, azimuth_to_deg: 40, count: 3, distance_m: DISTANCE}",
        "{tilt_deg: 35, azimuth_from_deg: 60, azimuth_to_deg: 120, count: 3, distance_m: 0.62}",
    )
    .replace("acceleration_rad_s2: 1.5", "acceleration_rad_s2: 20")
    .replace("window_s: 0.1", "window_s: 0.3")
)
SCAN = """\
id: faults
version: "1"
title: A scan while something goes wrong
spheres: {radius_mm: 15, registration: 10, control: 3}
steps:
  - id: scan
    kind: scan_import
    title: Scan
    params: {spheres: 10, wait_s: 6}
    gates: [{measure: spheres_found, min: 10, max: 10}]
    recovery: {retries: 1, wait_s: 0.2}
"""
CT = """\
id: faults
version: "1"
title: A CT series while something goes wrong
spheres: {radius_mm: 15, registration: 10, control: 3}
steps:
  - id: ct
    kind: ct_import
    title: CT
    params: {spheres: 5, wait_s: 6}
    gates: [{measure: slices, min: 20}, {measure: spheres_found, min: 5, max: 5}]
    recovery: {retries: 1, wait_s: 0.2}
  - id: scan
    kind: scan_import
    title: Scan
    params: {spheres: 5, wait_s: 6, compare_with: ct}
    gates: [{measure: spheres_compared, min: 5}, {measure: sphere_change_max_mm, max: 1}]
    recovery: {retries: 1, wait_s: 0.2}
"""


def exposed(number: int) -> NDArray[np.uint8]:
    """Take an exposure's time over a picture, so that samples of the arm arrive meanwhile."""
    time.sleep(0.3)
    return numbered(number)


class Laboratory(Station):
    """A station whose devices are in memory unless they are in the rig file."""

    def __init__(self, rig: Path, arm: BenchArm | None, shutter: BenchCamera | None) -> None:
        super().__init__(load_rig(rig))
        self.arm, self.shutter = arm, shutter
        for device in (arm, shutter):
            if device is not None:
                device.open()

    def robot(self, station: str) -> RobotArm:
        """The robot of a station, real or in memory."""
        return self.arm if self.arm is not None else super().robot(station)

    def camera(self) -> Camera:
        """The camera, real or in memory."""
        return self.shutter if self.shutter is not None else super().camera()

    def layout(self, station: str) -> StationLayout:
        """The layout of a station, from the rig file or for the in-memory arm."""
        return _BENCH if self.arm is not None else super().layout(station)

    def let_move(self, leave: LeaveToMove) -> None:
        """Permit motion of the real robot or of the in-memory arm."""
        super().let_move(leave)
        if self.arm is not None:
            self.arm.let_move(leave.by, leave.not_before_monotonic_s)

    def reopen(self, device: Device) -> None:
        """Reopen a device, real or in memory."""
        if device is self.arm or device is self.shutter:
            device.close()
            device.open()
        else:
            super().reopen(device)


def write_rig(
    folder: Path, devices: dict[str, Any], station: Mapping[str, Any] = _STATION, camera_m: float = 0.1
) -> Path:
    """Write a rig file, with the camera so far before the flange; returns it."""
    path = folder / "rig.yaml"
    rig = {
        "name": "faults",
        "simulated": True,
        "devices": devices,
        "stations": {"station_1": dict(station)} if "robot" in devices else {},
        "T_flange_camera_nominal": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, camera_m], [0, 0, 0, 1]],
        "collision": {"arm": "not in the table"},
        "lens": {"focal_length_mm": 50, "sensor_width_mm": 35.7, "image_px": [900, 600]},
    }
    path.write_text(yaml.safe_dump(rig, sort_keys=False))
    return path


class Simulators:
    """Simulators in processes forked from this one before it has threads."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._pids: dict[str, int] = {}

    def start(self, *words: str) -> dict[str, Any]:
        """Start `python -m simulators WORDS`; returns its ready line. Raises RuntimeError if it does not start."""
        reading, writing = os.pipe()
        parent = os.getpid()
        pid = os.fork()
        if pid == 0:
            try:
                os.close(reading)
                os.dup2(writing, 1)
                log = os.open(self._folder / f"simulated-{words[0]}.log", os.O_CREAT | os.O_APPEND | os.O_WRONLY)
                os.dup2(log, 2)
                sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w", buffering=1)
                status = simulate([*words, "--parent", str(parent)])
            except BaseException:  # noqa: BLE001 - the case reads that there is no ready line
                status = 3
            os._exit(status)
        os.close(writing)
        self._pids[words[0]] = pid
        with os.fdopen(reading) as lines:
            line = lines.readline()
        if not line:
            raise RuntimeError(f"the simulator did not start: {' '.join(words)}")
        return loads(line)

    def stop(self, names: Sequence[str] = ()) -> None:
        """End these simulators, or all of them."""
        for name in names or list(self._pids):
            pid = self._pids.pop(name, 0)
            with suppress(ProcessLookupError, ChildProcessError):
                if pid:
                    os.kill(pid, signal.SIGKILL)
                    os.waitpid(pid, 0)

    def signal(self, name: str, number: int) -> None:
        """Send a signal to a simulator."""
        os.kill(self._pids[name], number)
