"""Time as a test tells it: nothing waits for it, and whoever sleeps by it moves it on."""

from __future__ import annotations

import threading
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Self

from service.store.durable_effects import SystemClock

_BEGAN = datetime(2026, 11, 21, 12, 0, 0, 250000, tzinfo=UTC)
_BEGAN_MONOTONIC_S = 1000.0


class SteppedClock:
    """A clock that stands still unless a test sets `passed_s` or somebody sleeps; several threads may use it.

    With `look_s` it goes on by that at each look at the date, so that no two records have the same one.

    A sleep returns at once, with the time gone on by as much. Threads that wait on a signal are woken when it is set,
    or when the time has come.
    """

    def __init__(
        self, began: datetime = _BEGAN, began_monotonic_s: float = _BEGAN_MONOTONIC_S, look_s: float = 0.0
    ) -> None:
        self.on_sleep: Callable[[float], None] = lambda _seconds: None  # called before time goes on
        self._began, self._began_monotonic_s = began, began_monotonic_s
        self._passed_s, self._look_s = 0.0, look_s
        self._boots = 1
        self.moved = threading.Condition()  # notified when time has passed, or a signal was set

    @classmethod
    def from_now(cls) -> Self:
        """One that begins at the host's present time, with which the times of files and certificates agree."""
        host = SystemClock()
        return cls(host.utc_now(), host.monotonic_s(), look_s=1e-6)

    @property
    def passed_s(self) -> float:
        """The seconds that have passed since it was made; it may be set to any time."""
        return self._passed_s

    @passed_s.setter
    def passed_s(self, passed_s: float) -> None:
        with self.moved:
            self._passed_s = passed_s
            self.moved.notify_all()

    def utc_now(self) -> datetime:
        with self.moved:
            self._passed_s += self._look_s
            return self._began + timedelta(seconds=self._passed_s)

    def utc_s(self) -> float:
        """Seconds since the epoch."""
        return self.utc_now().timestamp()

    def monotonic_s(self) -> float:
        return self._began_monotonic_s + self._passed_s

    def boot(self) -> str:
        """The name of the present boot; `reboot` begins the next."""
        return f"boot-{self._boots}"

    def reboot(self, off_s: float, monotonic_s: float = 20.0) -> None:
        """The host is off for so long, and begins with a new boot and a monotonic clock of its own."""
        self.set_utc(off_s)
        self._began_monotonic_s, self._boots = monotonic_s - self._passed_s, self._boots + 1

    def set_utc(self, by_s: float) -> None:
        """UTC goes on or back by that, and the monotonic clock does not: the clock is set, or the host slept."""
        with self.moved:
            self._began += timedelta(seconds=by_s)
            self.moved.notify_all()

    def sleep(self, seconds: float) -> None:
        self.on_sleep(seconds)
        with self.moved:
            self._passed_s += seconds
            self.moved.notify_all()

    def signal(self) -> SteppedSignal:
        return SteppedSignal(self)


class SteppedSignal:
    """A signal on which threads wait by such a clock."""

    def __init__(self, clock: SteppedClock) -> None:
        self._clock = clock
        self._set = False

    def set(self) -> None:
        with self._clock.moved:
            self._set = True
            self._clock.moved.notify_all()

    def is_set(self) -> bool:
        return self._set

    def wait(self, timeout: float | None = None) -> bool:
        clock = self._clock
        due_s = float("inf") if timeout is None else clock.monotonic_s() + timeout
        with clock.moved:
            clock.moved.wait_for(lambda: self._set or clock.monotonic_s() >= due_s)
            return self._set
