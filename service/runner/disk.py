"""Watches free disk space while a run writes, and stops the run before the disk is full."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field

from service.core.disk_space import Forecast, Verdict
from service.core.protocol.models import Protocol
from service.core.records.events import StepNote
from service.runner.held_run import HeldRun
from service.store.disk_space import forecast_of, require_space

_FORECAST_EVERY_S = 30.0
_LOOK_EVERY_S = 2.0  # in this time a camera cannot fill the space that is kept free


@dataclass
class DiskWatch:
    """Forecasts whether the disk has room for the rest of the run; records and tells a forecast that is worse."""

    run: HeldRun
    protocol: Protocol
    tell: Callable[[str], None]
    monotonic_s: Callable[[], float]
    _due_s: float = field(init=False, default=0.0)
    _forecast_due_s: float = field(init=False, default=0.0)
    _stop_below_bytes: int = field(init=False, default=0)
    _told: Verdict = field(init=False, default="enough")

    def require(self) -> None:
        """Check the disk if the last check is old enough. Raises SpaceShortError if the run must stop."""
        now_s = self.monotonic_s()
        if now_s < self._due_s:
            return
        plenty = self.run.store.free_bytes() > 2 * self._stop_below_bytes
        if now_s >= self._forecast_due_s or not plenty:  # the forecast of a large run takes a tenth of a second
            found = self.forecast()
            require_space(self.run.store, found)
            self._stop_below_bytes = found.stop_below_bytes
            self._forecast_due_s = now_s + _FORECAST_EVERY_S
        self._due_s = now_s + _LOOK_EVERY_S

    def forecast(self) -> Forecast:
        """Make a forecast; record it and tell the operator if it is worse than the one before."""
        state = self.run.refresh()
        found = forecast_of(self.run.store, self.protocol, state)
        worse = found.verdict not in ("enough", self._told)
        self._told = found.verdict
        if worse:
            data = dataclasses.asdict(found) | {"verdict": found.verdict}
            self.run.append(StepNote(step=state.current, attempt=state.step.attempt, note="disk_space", data=data))
            if found.verdict == "short":
                self.tell(f"{found.words}. The run stops and asks before the disk is full")
        return found
