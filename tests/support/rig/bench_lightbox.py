"""The light box of the in-memory rig for tests of the runner."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from drivers.interfaces import DeviceIdentity, DeviceReport, EnvironmentReading, PedalReading, TowerLight
from service.store.durable_effects import Clock, SystemClock


@dataclass
class BenchLightbox:
    """A light box with a pedal."""

    presses: int = 0
    tower: bool = True
    serial: str = "L-1"
    on_read: Callable[[], None] = lambda: None  # may raise
    shown: list[TowerLight] = field(default_factory=list[TowerLight])
    clock: Clock = field(default_factory=SystemClock)
    _counted: int = field(init=False, default=0)
    _pressed_s: float = field(init=False, default=0.0)

    def open(self) -> DeviceIdentity:
        return self.report().identity

    def close(self) -> None:
        pass

    def report(self) -> DeviceReport:
        return DeviceReport(DeviceIdentity("lightbox", "Bench box", self.serial, "1", "bench", "1", "memory"))

    def read(self) -> EnvironmentReading:
        self.on_read()
        return EnvironmentReading(812.0, 21.5, False, self.clock.monotonic_s())

    def pedal(self) -> PedalReading:
        now_s = self.clock.monotonic_s()
        if self.presses != self._counted:
            self._counted, self._pressed_s = self.presses, now_s
        return PedalReading(self.presses, self._pressed_s, now_s)

    def show_tower(self, light: TowerLight) -> bool:
        self.shown.append(light)
        return self.tower
