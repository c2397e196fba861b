"""Runs the simulated GRBL turntable for tests, with a tap on its line that keeps what the host sent."""

from __future__ import annotations

import contextlib
import json
import os
import select
import threading
import tty
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import serial

from drivers.grbl import GrblAxis, GrblConfig
from drivers.host.hosted_device import hosted
from drivers.interfaces import RobotArm
from service.core.geometry import Transform, look_at
from tests.support.rig.patience import PATIENT_GRBL
from tests.support.rig.simulator_process import simulator

CENTRE_M = np.array([0.0, 0.0, 0.05])
TILT_DEG, DISTANCE_M = 35.0, 0.62
TURN = GrblAxis(letter="X", carries="specimen", direction=(0, 0, 1), from_deg=-700, to_deg=-5)
LIFT = GrblAxis(letter="Y", carries="camera", direction=(0, 0, 1), from_mm=-290, to_mm=-1)


def mount() -> Transform:
    """T_base_flange at 0, as the drawing of the simulated machine has it."""
    tilt = np.radians(TILT_DEG)
    eye = CENTRE_M + DISTANCE_M * np.array([0.0, -np.sin(tilt), np.cos(tilt)])
    return look_at(eye, CENTRE_M, np.array([0.0, 0.0, 1.0]))


def fault(**fields: object) -> tuple[str, str]:
    """The option for one planned fault."""
    return "--faults", json.dumps([{"device": "grbl", **fields}])


def grbl_config(port: Path, *axes: GrblAxis, **fields: float) -> GrblConfig:
    """The driver's section of a rig file for the simulated machine."""
    rows = tuple(tuple(map(float, row)) for row in mount())
    return GrblConfig.model_validate({"port": str(port), "axes": axes, "T_base_flange_zero": rows, **fields})


@contextmanager
def opened(port: Path, *axes: GrblAxis, **config: float) -> Generator[RobotArm]:
    """The driver in its own process, not yet allowed to move."""
    section = grbl_config(port, *(axes or (TURN,)), **{**PATIENT_GRBL, **config})
    arm = hosted(RobotArm, "drivers.grbl:DRIVER", section, call_timeout_s=60, name="table")
    try:
        arm.open()
        yield arm
    finally:
        arm.close()


@contextmanager
def table(folder: Path, *options: str) -> Generator[Path]:
    """A turntable at a port, ten times as fast as a real one homes."""
    port = folder / "table"
    with simulator("grbl", "--link", str(port), "--setting", "25=36000", "24=1200", *options):
        yield port


class Tap:
    """A line between the host and a serial port, which keeps what the host sent.

    Args:
        far_end: the port. folder: gets the host's end.
        spoil: what becomes of bytes on their way; its second argument says whether the host sent them.
    """

    def __init__(
        self, far_end: Path, folder: Path, spoil: Callable[[bytes, bool], bytes] = lambda data, _sent: data
    ) -> None:
        self.sent = b""
        self._spoil = spoil
        self._far = serial.Serial(str(far_end), timeout=0)
        self._ends = os.openpty()
        tty.setraw(self._ends[1])
        self.port = folder / "tapped"
        self.port.symlink_to(os.ttyname(self._ends[1]))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def __enter__(self) -> Tap:
        return self

    def __exit__(self, *_exc: object) -> None:
        self._stop.set()
        self._thread.join()
        self._far.close()
        for end in self._ends:
            os.close(end)

    def _run(self) -> None:
        near, far = self._ends[0], self._far.fileno()
        with contextlib.suppress(OSError):
            while not self._stop.is_set():
                for ready in select.select([near, far], [], [], 0.05)[0]:
                    data = os.read(ready, 4096)
                    if ready == near:
                        self.sent += data
                    os.write(far if ready == near else near, self._spoil(data, ready == near))
