"""Tells the operator, once a session, which clock is beyond its limit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from service.core.equipment.clocks import clock_readings
from service.run_record import RunFollower


@dataclass(frozen=True)
class ClockWatch:
    """Compares the clocks as the record has them."""

    follower: RunFollower
    tell: Callable[[str], None]
    _told: set[str] = field(init=False, default_factory=set[str])

    def look(self) -> None:
        """Tell of each clock that is beyond its limit and was not told of before."""
        for reading in clock_readings(self.follower.now().events):
            if reading.within is False and reading.device not in self._told:
                self._told.add(reading.device)
                self.tell(reading.words)
