"""Which calibration a controller computes poses with, as its primary interface states it to every new client.

Message and parts are those of Universal Robots' description of the primary and secondary interfaces: a robot state
(type 16) has parts, each with its size and type; part 5 is the kinematics.
"""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from drivers.errors import DeviceUnavailableError
from drivers.interfaces import Array
from service.core.arms import ArmModel, flange_pose
from service.core.units import mm

PORT = 30001
_STATE, _KINEMATICS = 16, 5
_HEAD = struct.Struct(">IB")
_PART = struct.Struct(">6I24dI")  # checksums; θ, a, d, α of each joint; status
_LONGEST = 1 << 16
_SAME_M = 1e-6
#: What to report of a calibration, for the published dimensions of an arm and its joints (6,).
Calibration = Callable[[ArmModel | None, Array], str]
_REMEDY = "Enable the primary client interface on the pendant if you want to know the controller's calibration"


@dataclass(frozen=True, slots=True)
class ControllerKinematics:
    """The Denavit–Hartenberg parameters with which a controller computes: those published, or this arm's own."""

    theta_rad: tuple[float, ...]
    a_m: tuple[float, ...]
    d_m: tuple[float, ...]
    alpha_rad: tuple[float, ...]

    def fields(self) -> dict[str, tuple[float, ...]]:
        """The parameters by name."""
        return {"theta_rad": self.theta_rad, "a_m": self.a_m, "d_m": self.d_m, "alpha_rad": self.alpha_rad}

    def departure_m(self, published: ArmModel, joints_rad: Array) -> float:
        """How far it has the flange from where the published dimensions put it."""
        own = replace(published, a_m=np.array(self.a_m), d_m=np.array(self.d_m), alpha_rad=np.array(self.alpha_rad))
        there = flange_pose(own, joints_rad + np.array(self.theta_rad))
        return float(np.linalg.norm((there - flange_pose(published, joints_rad))[:3, 3]))

    def words(self, published: ArmModel | None, joints_rad: Array) -> str:
        """Return what to report of it, with the arm at these joints (6,)."""
        if published is None:
            return "stated, for an arm that is not known here"
        away_m = self.departure_m(published, joints_rad)
        if away_m < _SAME_M:
            return "the published dimensions: the controller has no calibration of this arm"
        return f"this arm's own: the flange is {mm(away_m):.2f} mm from where the published dimensions put it"


def calibration_of(host: str, timeout_s: float) -> Calibration:
    """The controller's calibration in words, or why it is not known: nothing else depends on it."""
    try:
        return read_kinematics(host, timeout_s).words
    except DeviceUnavailableError as error:
        why = error.what
    return lambda _published, _joints_rad: why


def read_kinematics(host: str, timeout_s: float) -> ControllerKinematics:
    """Ask a controller with which parameters it computes.

    Raises DeviceUnavailableError if it does not say so within this time.
    """
    deadline_s = time.monotonic() + timeout_s
    try:
        with socket.create_connection((host, PORT), timeout=timeout_s) as connection:
            data = b""
            while time.monotonic() < deadline_s:
                received = connection.recv(4096)
                if not received:
                    break
                data += received
                found, data = take_kinematics(data)
                if found is not None:
                    return found
    except OSError as error:
        raise _unstated(host, f"{error.strerror or error}") from error
    raise _unstated(host, "the interface answers without it")


def take_kinematics(data: bytes) -> tuple[ControllerKinematics | None, bytes]:
    """The kinematics in the whole messages of a stream, if they have any, and what is left of it.

    Raises ConnectionError if this is no such stream.
    """
    while len(data) >= _HEAD.size:
        size, kind = _HEAD.unpack_from(data)
        if not _HEAD.size <= size <= _LONGEST:
            raise ConnectionError("the answer is not that of a primary interface")
        if len(data) < size:
            break
        message, data = data[_HEAD.size : size], data[size:]
        if kind == _STATE and (found := _in_state(message)) is not None:
            return found, data
    return None, data


def _in_state(parts: bytes) -> ControllerKinematics | None:
    while len(parts) >= _HEAD.size:
        size, kind = _HEAD.unpack_from(parts)
        if not _HEAD.size <= size <= len(parts):
            raise ConnectionError("a part of the robot's state is cut off")
        if kind == _KINEMATICS and size >= _HEAD.size + _PART.size:
            numbers = _PART.unpack_from(parts, _HEAD.size)[6:30]
            if not np.all(np.isfinite(numbers)):
                raise ConnectionError("the kinematics hold something that is no number")
            return ControllerKinematics(numbers[:6], numbers[6:12], numbers[12:18], numbers[18:])
        parts = parts[size:]
    return None


def _unstated(host: str, why: str) -> DeviceUnavailableError:
    return DeviceUnavailableError(f"the calibration is not stated: {why}", where=f"{host}:{PORT}", remedy=_REMEDY)
