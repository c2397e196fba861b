"""Fuzz targets behind native libraries: a camera and a robot whose answers are spoilt on the wire.

The libraries (libgphoto2, ur_rtde) run in the driver's process, which may crash or hang; the caller must get a
DeviceError in time. An input is an offset, and bytes that replace the device's answers from there on.
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import threading
import time
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from hypothesis import strategies as st
from hypothesis.strategies import DrawFn

from drivers.gphoto import GphotoConfig
from drivers.host.hosted_device import hosted
from drivers.interfaces import Camera, RobotArm
from drivers.ur import UrConfig
from simulators.faults import FaultPlan
from simulators.sony_camera.body import SonyBody
from simulators.sony_camera.server import SonyServer
from simulators.still_camera.body import BodyOptions
from simulators.still_camera.scene import StillLife
from simulators.ur_controller.controller import Controller
from simulators.ur_controller.kinematics import MODELS
from simulators.ur_controller.server import DASHBOARD_PORT, RTDE_PORT, SCRIPT_PORT, Server
from tests.support.torture.fuzz.targets.target import MisbehavedError, Target

_CALL_S = 20.0  # time after which the driver's process is ended
_NEAR, _FAR = (f"127.{100 + os.getpid() % 100}.{os.getpid() // 100 % 250}.{last}" for last in (8, 9))


class _Spoiler:
    """Forwards connections to a device and overwrites its answers with the input."""

    def __init__(self, listen: tuple[str, int], device: tuple[str, int], *, spoils: bool = True) -> None:
        self._device, self._spoils = device, spoils
        self.at, self.over = 0, b""
        self._listener = socket.create_server(listen)
        self.port = int(self._listener.getsockname()[1])
        threading.Thread(target=self._accept, daemon=True).start()

    def spoil(self, data: bytes) -> None:
        """Overwrite answers from the next connection on."""
        at = struct.unpack("<I", data[:4].ljust(4, b"\0"))[0]
        self.at, self.over = at % 60_000, data[4:]

    def _accept(self) -> None:
        while True:
            near, _ = self._listener.accept()
            try:
                far = socket.create_connection(self._device, timeout=5.0)
            except OSError:
                near.close()
                continue
            far.settimeout(None)
            for one in (near, far):
                one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            threading.Thread(target=self._hand_on, args=(near, far, b"", 0), daemon=True).start()
            over = self.over if self._spoils else b""
            threading.Thread(target=self._hand_on, args=(far, near, over, self.at), daemon=True).start()

    @staticmethod
    def _hand_on(source: socket.socket, sink: socket.socket, over: bytes, at: int) -> None:
        passed = 0
        with contextlib.suppress(OSError):
            while data := source.recv(1 << 16):
                changed = bytearray(data)
                for index, value in enumerate(over, at - passed):
                    if 0 <= index < len(changed):
                        changed[index] ^= value
                passed += len(data)
                sink.sendall(changed)
        for one in (source, sink):
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)


def _overlay(draw: DrawFn, data: bytes) -> bytes:
    """Choose another offset and other bytes for the overlay."""
    del data
    near = draw(st.sampled_from((400, 3_000, 60_000)))
    return struct.pack("<I", draw(st.integers(0, near))) + draw(st.binary(min_size=1, max_size=16))


def _untouched(_: Path) -> list[bytes]:
    return [struct.pack("<I", 0) + b"\0"]


# --- camera -------------------------------------------------------------------------------------------------------


@dataclass
class _CameraRig:
    device: Camera
    spoiler: _Spoiler


@cache
def _camera_rig() -> _CameraRig:
    """The camera rig, made once per process; the driver's process ends with it."""
    server = SonyServer("127.0.0.1", 0, SonyBody(StillLife(96), FaultPlan(), BodyOptions(fast=True)), FaultPlan())
    server.__enter__()
    spoiler = _Spoiler(("127.0.0.1", 0), server.address)
    config = GphotoConfig(port=f"ptpip:127.0.0.1:{spoiler.port}:{spoiler.port}", capture_timeout_s=3.0)
    device = hosted(Camera, "drivers.gphoto:DRIVER", config, call_timeout_s=_CALL_S, name="camera")
    return _CameraRig(device, spoiler)


def _camera(data: bytes, folder: Path) -> None:
    rig = _camera_rig()
    rig.spoiler.spoil(data)
    began_s = time.monotonic()
    try:
        rig.device.open()
        rig.device.settings()
        rig.device.report()
        image = rig.device.capture(folder)
        if image.width > 1 << 16 or not image.files:
            raise MisbehavedError(f"an image of {image.width} pixels in {len(image.files)} files is accepted")
    finally:
        rig.device.close()
        _in_time(began_s, calls=5)


def _in_time(began_s: float, *, calls: int) -> None:
    if time.monotonic() - began_s > calls * (_CALL_S + 15.0):
        raise MisbehavedError("calls of the driver did not end in time")


# --- robot --------------------------------------------------------------------------------------------------------


@dataclass
class _RobotRig:
    device: RobotArm
    spoiler: _Spoiler


@cache
def _robot_rig() -> _RobotRig:
    controller = Controller(
        MODELS["UR10e"], (5, 12), joints=np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0]), serial="20235000",
        faults=FaultPlan(), device="robot", speed_up=1.0,
    )  # fmt: skip
    server = Server(controller, _FAR, None, 30090)
    threading.Thread(target=server.run, args=(_Never(),), daemon=True).start()
    spoilers = [
        _Spoiler((_NEAR, port), (_FAR, port), spoils=port == RTDE_PORT)
        for port in (RTDE_PORT, DASHBOARD_PORT, SCRIPT_PORT)
    ]
    config = UrConfig(host=_NEAR, connect_timeout_s=2.0)
    return _RobotRig(hosted(RobotArm, "drivers.ur:DRIVER", config, call_timeout_s=_CALL_S, name="robot"), spoilers[0])


class _Never:
    """A termination that is never set: the simulator ends with its process."""

    def is_set(self) -> bool:
        """Never set."""
        return False


def _robot(data: bytes, folder: Path) -> None:
    del folder
    rig = _robot_rig()
    rig.spoiler.spoil(data)
    began_s = time.monotonic()
    try:
        rig.device.open()
        state = rig.device.state()
        if state.sample.joints_rad.shape != (6,):
            raise MisbehavedError("a sample without six joints is accepted")
        rig.device.report()
    finally:
        rig.device.close()
        _in_time(began_s, calls=4)


TARGETS: tuple[Target, ...] = (
    Target(
        "camera_wire", "drivers.host:hosted(drivers.gphoto)", _camera, _untouched, (_overlay,),
        memory_mib=512, seconds=20.0, pace=0.02,
    ),
    Target(
        "robot_wire", "drivers.host:hosted(drivers.ur)", _robot, _untouched, (_overlay,),
        memory_mib=512, seconds=20.0, pace=0.02,
    ),
)  # fmt: skip
