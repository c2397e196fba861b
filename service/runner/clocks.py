"""Tells the operator, once per session, of each clock beyond its limit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from service.core.clocks import clock_readings
from service.run_record import RunFollower


@dataclass(frozen=True)
class ClockWatch:
    """Checks the recorded clock offsets and tells of those beyond their limits."""

    follower: RunFollower
    tell: Callable[[str], None]
    _told: set[str] = field(init=False, default_factory=set[str])

    def look(self) -> None:
        """Tell of each clock beyond its limit that has not been told of yet."""
        for reading in clock_readings(self.follower.now().events):
            if reading.within is False and reading.device not in self._told:
                self._told.add(reading.device)
                self.tell(reading.words)
