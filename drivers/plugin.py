"""How a driver registers: a DriverSpec behind an entry point of the group `orthocapture.drivers`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from pydantic import BaseModel, ConfigDict

from drivers.interfaces import Abandoned, Device

READING_TIMEOUT_S = 45.0


class DriverConfig(BaseModel):
    """Base class of a driver's section in rig.yaml."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    @property
    def abandoned(self) -> Abandoned | None:
        """Return what becomes of a motion whose program died; None for a device that limits its speed by itself."""
        return None

    @property
    def longest_call_s(self) -> float:
        """Longest time that one call may take with this configuration, if it exceeds the driver's usual timeout."""
        return 0.0


@runtime_checkable
class NeedsHeartbeat(Protocol):
    """A hosted driver that must know at all times that the program using it is alive."""

    def heartbeat(self, sent_monotonic_s: float) -> None:
        """Receive a heartbeat that was sent at this host time.monotonic().

        Called from a separate thread; must return at once.
        """
        ...


@dataclass(frozen=True, slots=True)
class DriverSpec:
    """Holds what the station needs to know to open a device.

    Attributes:
        kind: robot, camera, scanner, ct or lightbox.
        config: the pydantic model of the driver's section in rig.yaml (without the key `driver`).
        build: creates the driver object from a validated config, without connecting.
        hosted: whether the driver must run in a supervised child process (for native libraries).
        call_timeout_s: longest time that one call may take before the child is killed; a config may ask for more.
        reading_timeout_s: the same for calls that only read what the device knows (`report`, `settings`), if shorter.
        is_arm: true for a robot that is an arm. The motions of other axes are not planned; their driver finds them.
    """

    kind: str
    config: type[DriverConfig]
    build: Callable[[Any], Device]
    hosted: bool = False
    call_timeout_s: float = 60.0
    reading_timeout_s: float = READING_TIMEOUT_S
    is_arm: bool = True
