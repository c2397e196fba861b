"""Events of a run as a whole: its start, its sessions and devices, its end."""

from __future__ import annotations

from typing import Any, Literal

from service.core.records.base import ArtefactRef, Record
from service.core.records.entered import RunAbout


class RunStarted(Record):
    """Root of the chain."""

    kind: Literal["run_started"] = "run_started"
    protocol_id: str
    protocol_version: str
    protocol_sha256: str
    protocol: ArtefactRef
    rig: ArtefactRef
    simulated: bool
    auto_confirm: bool
    operator: str
    software: dict[str, str]  # distribution → version
    # imported: the photographs were captured earlier, elsewhere; `rig` is then the list of what was imported
    origin: Literal["captured", "imported"] = "captured"
    about: RunAbout | None = None  # None: nothing was entered


class HostClock(Record):
    """How well the host's clock is set; None stands for not known."""

    source: Literal["chrony", "kernel", ""]
    synchronised: bool | None  # with the network's time
    offset_s: float | None  # host minus network
    error_s: float | None = None  # the kernel's bound on the error


class SessionStarted(Record):
    """The runner's process started, for the first time or on resume; records versions and the host's clock."""

    kind: Literal["session_started"] = "session_started"
    resumed: bool
    software: dict[str, str]
    host: str
    pid: int
    host_clock: HostClock | None = None


class DeviceOpened(Record):
    """A device was opened; `report` is its DeviceReport as plain data."""

    kind: Literal["device_opened"] = "device_opened"
    device: str  # name in rig.yaml
    report: dict[str, Any]


class DeviceTrouble(Record):
    """A device failed, stopped or was restarted."""

    kind: Literal["device_trouble"] = "device_trouble"
    device: str
    error: str
    message: str
    data_safe: bool = True
    # How the connection to an arm ended with it, or that none could be made; "" where it did not end.
    connection: Literal["", "died", "stalled", "broken", "refused"] = ""


class LeaveLapsed(Record):
    """A person's confirmation that the robot may move is over: nothing visible came of it for too long."""

    kind: Literal["leave_lapsed"] = "leave_lapsed"
    leave_seq: int  # of the event that gave it
    idle_s: float  # without visible progress since then, or since the last progress
    limit_s: float  # of the protocol: motion.confirmed_for_s
    why: str = ""  # what the run had waited for, in words; "" if it is not known


class RunCompleted(Record):
    """Every step passed or was skipped."""

    kind: Literal["run_completed"] = "run_completed"
    deviations: int


class RunAborted(Record):
    """A person or a step's recovery policy ended the run early; what was captured stays."""

    kind: Literal["run_aborted"] = "run_aborted"
    reason: str
