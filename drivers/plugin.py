"""How a driver announces itself: one DriverSpec behind an entry point of the group `orthocapture.drivers`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from pydantic import BaseModel, ConfigDict

from drivers.interfaces import Device


class DriverConfig(BaseModel):
    """Base of a driver's section in rig.yaml."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @property
    def longest_call_s(self) -> float:
        """Time that one call may take by this configuration, where that may exceed the driver's usual time."""
        return 0.0


@runtime_checkable
class NeedsHeartbeat(Protocol):
    """A hosted driver that must know at every moment that the program which uses it is alive."""

    def heartbeat(self, sent_monotonic_s: float) -> None:
        """A sign of life, sent at that host time; called in a thread of its own, and must return at once."""
        ...


@dataclass(frozen=True, slots=True)
class DriverSpec:
    """What the station needs to know to open a device.

    Attributes:
        kind: robot, camera, scanner, ct or lightbox.
        config: the pydantic model of the driver's section in rig.yaml (without the key `driver`).
        build: makes the driver object from a validated config; connects to nothing yet.
        hosted: whether the driver must run in a supervised child process (native libraries).
        call_timeout_s: longest time that one call may take before the child is restarted; a config may ask for more.
    """

    kind: str
    config: type[DriverConfig]
    build: Callable[[Any], Device]
    hosted: bool = False
    call_timeout_s: float = 60.0
