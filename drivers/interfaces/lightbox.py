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


@dataclass(frozen=True, slots=True)
class PedalReading:
    """The count of the foot pedal, and when it was last pressed by the clock of the box.

    The times are seconds since the box was switched on; None where the box does not tell them. Two presses are set
    apart by them alone: what the host knows of a press is only that it lies between two of its readings.
    """

    presses: int  # since the box was switched on
    pressed_s: float | None = None  # the last press; 0.0 before the first
    now_s: float | None = None  # the reading itself


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

    def pedal(self) -> PedalReading:
        """Return the foot pedal's count, as two readings in a row agree on it."""
        ...

    def show_tower(self, light: TowerLight) -> bool:
        """Switch the signal tower. Returns False if the box has none, which is not an error."""
        ...
