"""The ages of times that are kept in UTC alone, as the monotonic clock of this process confirms them."""

from __future__ import annotations

from collections import OrderedDict
from threading import Lock

from service.store.durable_effects import Clock

_KEPT = 10_000  # times that are remembered, the newest


class Ages:
    """How old a time in UTC is at least and at most.

    When this process first meets a time, it keeps its age by UTC. From then on the monotonic clock says how much
    older it has become, beside UTC. The host's clock may be set meanwhile, and the host may sleep; of the two ages
    the smaller says how long somebody has surely waited, the larger how old something may be. A new process begins
    with UTC, so that a restart of the host is bridged.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._met: OrderedDict[float, tuple[float, float]] = OrderedDict()  # time → its age then, monotonic time then
        self._lock = Lock()

    def begin(self, since_utc_s: float) -> None:
        """Meet a time that is being recorded, so that both clocks count from now on."""
        self._both(since_utc_s)

    def at_least_s(self, since_utc_s: float) -> float:
        """The age in seconds that has surely passed; negative before the time has come."""
        return min(self._both(since_utc_s))

    def at_most_s(self, since_utc_s: float) -> float:
        """The largest age in seconds that it may have; negative before the time has come."""
        return max(self._both(since_utc_s))

    def _both(self, since_utc_s: float) -> tuple[float, float]:
        """The age by UTC and that by the monotonic clock."""
        age_s, now_s = self._clock.utc_s() - since_utc_s, self._clock.monotonic_s()
        with self._lock:
            age_then_s, then_s = self._met.setdefault(since_utc_s, (age_s, now_s))
            self._met.move_to_end(since_utc_s)
            while len(self._met) > _KEPT:
                self._met.popitem(last=False)
        return age_s, age_then_s + now_s - then_s
