"""What every device can do, and how it reports itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from service.core.errors import printable

Array = NDArray[np.float64]
Transform = Array  # (4, 4), T_a_b: p_a = T_a_b @ p_b, metres


@dataclass(frozen=True, slots=True)
class DeviceIdentity:
    """The device that answered when it was opened; recorded in the evidence of a run."""

    kind: str  # robot, camera, scanner, ct, lightbox
    model: str
    serial: str
    firmware: str
    driver: str
    driver_version: str  # our driver and the vendor library behind it
    address: str


@dataclass(frozen=True, slots=True)
class DeviceReport:
    """The health of an open device, for `orthocapture doctor` and the run's start-up log."""

    identity: DeviceIdentity
    clock_offset_s: float | None = None  # device clock minus host UTC, or minus host monotonic for an uptime clock
    clock: Literal["utc", "uptime"] = "utc"  # uptime: counts from power-on, so only changes of the offset matter
    free_bytes: int | None = None
    battery_fraction: float | None = None
    details: Mapping[str, str] = field(default_factory=dict[str, str])
    problems: tuple[str, ...] = ()  # each says what is wrong and what to do

    def __post_init__(self) -> None:
        # They quote names of files, which may be any bytes and could then be neither shown nor recorded.
        object.__setattr__(self, "problems", tuple(map(printable, self.problems)))


@runtime_checkable
class Device(Protocol):
    """Declares what every driver provides. Methods raise only drivers.errors.DeviceError."""

    def open(self) -> DeviceIdentity:
        """Connect, check the version and return the device's identity. Calling it again reconnects."""
        ...

    def close(self) -> None:
        """Disconnect from the device; does not raise if the link is already dead."""
        ...

    def report(self) -> DeviceReport:
        """Return versions, clock offset, free space and current problems."""
        ...
