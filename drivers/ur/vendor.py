"""Types for the part of ur_rtde that the driver uses; the library itself ships none."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Generator
from pathlib import Path
from typing import Protocol, cast

import rtde_control
import rtde_receive

TIMER_SLACK_NS = 2_000_000


class Connection(Protocol):
    """The methods that both interfaces share."""

    def isConnected(self) -> bool: ...  # noqa: D102 - the vendor's names and meanings
    def disconnect(self) -> None: ...  # noqa: D102


class Receive(Connection, Protocol):
    """rtde_receive.RTDEReceiveInterface."""

    def getTimestamp(self) -> float: ...  # noqa: D102
    def getActualQ(self) -> list[float]: ...  # noqa: D102
    def getActualQd(self) -> list[float]: ...  # noqa: D102
    def getTargetQd(self) -> list[float]: ...  # noqa: D102
    def getActualTCPPose(self) -> list[float]: ...  # noqa: D102
    def getActualTCPSpeed(self) -> list[float]: ...  # noqa: D102
    def getSafetyStatusBits(self) -> int: ...  # noqa: D102
    def getRobotMode(self) -> int: ...  # noqa: D102
    def getRuntimeState(self) -> int: ...  # noqa: D102
    def getTargetSpeedFraction(self) -> float: ...  # noqa: D102
    def getPayload(self) -> float: ...  # noqa: D102
    def getPayloadCog(self) -> list[float]: ...  # noqa: D102


class AsyncStatus(Protocol):
    """rtde_control.AsyncOperationStatus."""

    def isAsyncOperationRunning(self) -> bool: ...  # noqa: D102


class Control(Connection, Protocol):
    """rtde_control.RTDEControlInterface; its calls return False on failure."""

    def isProgramRunning(self) -> bool: ...  # noqa: D102
    def reuploadScript(self) -> bool: ...  # noqa: D102
    def stopScript(self) -> None: ...  # noqa: D102
    def setTcp(self, pose: list[float]) -> bool: ...  # noqa: D102
    def getTCPOffset(self) -> list[float]: ...  # noqa: D102
    def setPayload(self, mass_kg: float, cog_m: list[float]) -> bool: ...  # noqa: D102
    def moveJ(self, q: list[float], speed: float, acceleration: float, asynchronous: bool) -> bool: ...  # noqa: D102
    def stopJ(self, deceleration: float, asynchronous: bool) -> None: ...  # noqa: D102
    def setWatchdog(self, min_frequency_hz: float) -> bool: ...  # noqa: D102
    def kickWatchdog(self) -> bool: ...  # noqa: D102
    def getAsyncOperationProgressEx(self) -> AsyncStatus: ...  # noqa: D102
    def getInverseKinematicsHasSolution(self, pose: list[float], near: list[float]) -> bool: ...  # noqa: D102
    def getInverseKinematics(self, pose: list[float], near: list[float]) -> list[float]: ...  # noqa: D102
    def isJointsWithinSafetyLimits(self, q: list[float]) -> bool: ...  # noqa: D102


def receive(host: str, frequency_hz: float, variables: list[str]) -> Receive:
    """Connect the receive interface and stream these RTDE output fields. Raises RuntimeError."""
    with _slack():
        return cast("Receive", rtde_receive.RTDEReceiveInterface(host, frequency_hz, variables))


def control(host: str, frequency_hz: float, *, upper_registers: bool) -> Control:
    """Connect the control interface and start its script, without the registers of an external force sensor.

    With `upper_registers` it uses registers 24 to 47. Raises RuntimeError.
    """
    interface = rtde_control.RTDEControlInterface
    flags = interface.FLAG_UPLOAD_SCRIPT | interface.FLAG_NO_EXT_FT
    if upper_registers:
        flags |= interface.FLAG_UPPER_RANGE_REGISTERS
    with _slack():
        return cast("Control", interface(host, frequency_hz, flags))


@contextlib.contextmanager
def _slack() -> Generator[None]:
    """Give threads started meanwhile a timer slack of TIMER_SLACK_NS, where the operating system is Linux.

    Each interface of the library has a thread that looks for data and sleeps for 0.1 ms, again and again: thousands
    of times a second, for 125 packages. With this slack it sleeps for 2 ms, a quarter of the time between packages.
    """
    file = Path(f"/proc/{threading.get_native_id()}/timerslack_ns")
    before = ""
    with contextlib.suppress(OSError):
        before = file.read_text()
        file.write_text(str(TIMER_SLACK_NS))
    try:
        yield
    finally:
        if before:
            with contextlib.suppress(OSError):
                file.write_text(before)
