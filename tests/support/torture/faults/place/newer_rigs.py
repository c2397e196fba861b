"""The rigs of a case with a turntable under GRBL, a KUKA arm, a GigE Vision camera, or a video camera."""

from __future__ import annotations

import multiprocessing
import os
import signal
import socket
import struct
import threading
import time
from contextlib import closing, suppress
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from tests.support.arms.grbl_simulator import CENTRE_M, TURN, mount
from tests.support.torture.faults.place.person import PlaceEye
from tests.support.torture.faults.wire.proxy import Wire

if TYPE_CHECKING:
    from tests.support.torture.faults.trial import Trial

TABLE_STATION: dict[str, Any] = {
    "robot": "robot", "scene_centre_m": CENTRE_M.tolist(), "approach_azimuth_deg": -90.0,
}  # fmt: skip
KUKA_STATION: dict[str, Any] = {
    "robot": "robot", "scene_centre_m": [0.55, 0.0, 0.0], "approach_azimuth_deg": 180,
}  # fmt: skip
_FRAME_S = 0.04
_GVCP = 3956
_FRI, _FRI_SPOILT = 30200, 30201  # where the driver listens, and where the controller sends


def table_rig(trial: Trial, plan: list[str]) -> dict[str, Any]:
    """A turntable; returns its section of the rig file."""
    far, line = trial.folder / "far", trial.folder / "line"
    eye = PlaceEye()
    trial.simulators.start(
        "grbl", "--link", str(far), "--world", eye.address, "--speed-up", "3",
        "--setting", "25=36000", "24=1200", "120=250", *plan,
    )  # fmt: skip
    trial.wired(Wire("table", "grbl", str(line), str(far)))
    trial.watch(eye)
    return {
        "driver": "grbl", "port": str(line if trial.proxy else far), "connect_timeout_s": 4.0,
        "axes": [TURN.model_dump(mode="json", exclude_none=True)], "T_base_flange_zero": mount().tolist(),
    }  # fmt: skip


def kuka_rig(trial: Trial, plan: list[str], *, fri: bool = False) -> dict[str, Any]:
    """A KUKA arm, with its poses from FRI if asked for; returns its section of the rig file."""
    near, listens = trial.arm_host[:-1] + "2", trial.arm_host[:-1] + "3"
    eye = PlaceEye()
    trial.simulators.start("kuka", "--host", trial.arm_host, "--speed-up", "3", "--world", eye.address, *plan)
    told = (b'"port":%d' % _FRI, b'"port":%d' % _FRI_SPOILT) if fri else (b"", b"")
    trial.wired(
        Wire("kuka", "kuka", (near, 30010), (trial.arm_host, 30010), told),
        *([Wire("kuka", "fri", (listens, _FRI_SPOILT), (listens, _FRI))] if fri else []),
    )
    trial.watch(eye)
    host = near if trial.proxy else trial.arm_host
    return {
        "driver": "kuka_sunrise",
        "host": host,
        "connect_timeout_s": 4.0,
        "answer_timeout_s": 2.0,
        "stale_after_s": 4.0,
        **({"fri_port": _FRI, "fri_host": listens} if fri else {}),
    }


def pendant(trial: Trial, order: str) -> None:
    """Do what a person does at the smartPAD."""
    with socket.create_connection((trial.arm_host, 30011), timeout=5) as link, link.makefile("rw") as lines:
        lines.write(order + "\n")
        lines.flush()
        lines.readline()


def gige_rig(trial: Trial, plan: list[str]) -> dict[str, Any]:
    """An industrial camera; returns its section of the rig file."""
    near = trial.arm_host[:-1] + "2"
    trial.simulators.start("gige", "--host", trial.arm_host, "--image-width", "96", *plan)
    trial.wired(Wire("gige", "gige", (near, _GVCP), (trial.arm_host, _GVCP)))
    host = near if trial.proxy else trial.arm_host
    return {"driver": "genicam", "camera": host, "aperture_f": 22.0, "frame_timeout_s": 2.0}


class OtherClient:
    """Another program that controls a GigE Vision camera."""

    def __init__(self, host: str) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect((host, _GVCP))
        self._number = 0
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._hold, daemon=True)
        self._thread.start()

    def _hold(self) -> None:
        while not self._end.wait(0.2):
            self._control(2)
        self._control(0)
        self._socket.close()

    def _control(self, value: int) -> None:
        self._number = self._number % 0xFFFF + 1
        with suppress(OSError):
            self._socket.send(struct.pack(">BBHHHII", 0x42, 1, 0x82, 8, self._number, 0xA00, value))

    def let_go(self) -> None:
        """Give the camera back."""
        self._end.set()
        self._thread.join(5.0)


# --- video --------------------------------------------------------------------------------------------------------


class Film:
    """The program that writes a camera's JPEG files into a named pipe, 25 a second, in a process of its own."""

    def __init__(self, pipe: Path) -> None:
        self.pipe = pipe
        self._process: BaseProcess | None = None

    def run(self, how: str = "") -> None:
        """Start or restart, with images that are `frozen`, `damaged`, `other_size` or `noise`; "" for good ones."""
        self.end()
        process = multiprocessing.get_context("fork").Process(target=_write, args=(self.pipe, how), daemon=True)
        process.start()
        self._process = process

    def end(self) -> None:
        """End it, as a camera that is pulled."""
        if self._process is not None and self._process.pid is not None:
            with suppress(ProcessLookupError):
                os.kill(self._process.pid, signal.SIGKILL)
            self._process.join(5.0)

    def pause(self) -> None:
        """Let it stand still."""
        if self._process is not None and self._process.pid is not None:
            os.kill(self._process.pid, signal.SIGSTOP)


def video_rig(trial: Trial) -> dict[str, Any]:
    """A video camera; returns its section of the rig file."""
    pipe = trial.folder / "pipe"
    os.mkfifo(pipe)
    trial.film = Film(pipe)
    trial.film.run()
    trial.ends.append(trial.film.end)
    return {
        "driver": "video", "port": str(pipe), "aperture_f": 22.0, "exposure_s": 0.02, "iso": 100,
        "frame_timeout_s": 3.0, "latency_s": 0.1,
    }  # fmt: skip


def _write(pipe: Path, how: str) -> None:
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    rng = np.random.default_rng(os.getpid())
    size = (48, 64) if how == "other_size" else (96, 144)
    with closing(pipe.open("wb")) as stream:
        jpeg = b""
        while True:
            if not jpeg or how != "frozen":
                picture = rng.integers(90, 120, (*size, 3), dtype=np.uint8)
                jpeg = cv2.imencode(".jpg", picture)[1].tobytes()
            sent = jpeg
            if how == "damaged":
                sent = jpeg[: len(jpeg) // 2] + rng.bytes(len(jpeg) // 4) + jpeg[-2:]
            if how == "noise":
                sent = rng.bytes(len(jpeg))
            stream.write(sent)
            stream.flush()
            time.sleep(_FRAME_S)
