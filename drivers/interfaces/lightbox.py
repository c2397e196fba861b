"""The interface of a light and environment box."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from drivers.interfaces.device import Device


@dataclass(frozen=True, slots=True)
class EnvironmentReading:
    """Light and temperature at one moment."""

    light_lux: float
    temperature_c: float
    shutter_relay_closed: bool
    monotonic_s: float


class TowerLight(Enum):
    """One light of a signal tower that can be seen across the room."""

    OFF = "OFF"
    WORKING = "GREEN"
    WAITING = "YELLOW"  # for a person
    STOPPED = "RED"


class Lightbox(Device, Protocol):
    """The light and environment box: light level, temperature, shutter relay, foot pedal and signal tower."""

    def read(self) -> EnvironmentReading:
        """Return the current light level, temperature and relay state."""
        ...

    def pedal_presses(self) -> int:
        """Return the number of pedal presses since the box started; an increase means a new press."""
        ...

    def show_tower(self, light: TowerLight) -> bool:
        """Switch the signal tower. Returns False if the box has none, which is not an error."""
        ...
