"""What keeps the runner itself from going on, such as a full disk: the run waits, says why, and then goes on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from drivers.errors import DeviceError
from service.core.errors import IntegrityError, StoreError
from service.runner.operator import Operator
from service.steps.context import Devices
from service.store.records import LeaseHeldError, LeaseLostError, RecordDamagedError
from service.store.store import Store

PASSING = (StoreError, OSError, MemoryError, DeviceError)
FINAL = (IntegrityError, LeaseHeldError, LeaseLostError, RecordDamagedError)
_AGAIN_S = 1.0
_TOLD_AGAIN_S = 60.0


@dataclass
class RecordTrouble:
    """Waits while the runner cannot read or write its record. The arms stand, and move only after a new leave.

    A record that is not what it was, or that another process writes, is not waited for.
    """

    store: Store
    devices: Devices
    operator: Operator
    _since_s: float | None = field(init=False, default=None)
    _told: str = field(init=False, default="")
    _tell_at_s: float = field(init=False, default=0.0)

    def wait_out(self, error: Exception) -> None:
        """Say what is wrong and wait a moment before the runner tries again.

        Raises the error if it is final, and StoreError if the database is no longer where it was opened.
        """
        if isinstance(error, FINAL):
            raise error
        now_s = self.store.clock.monotonic_s()
        if self._since_s is None:
            self._since_s = now_s
            self.devices.hold_arms()
        self.store.database.require_in_place()
        why = str(error) or type(error).__name__
        if why != self._told or now_s >= self._tell_at_s:
            self._told, self._tell_at_s = why, now_s + _TOLD_AGAIN_S
            self.operator.tell(
                f"the run waits, since {now_s - self._since_s:.0f} s: {why}. It goes on by itself once that is put "
                "right; nothing moves meanwhile, and what was recorded is safe"
            )
        self.operator.stuck(why, now_s - self._since_s)
        self.store.clock.sleep(_AGAIN_S)

    def over(self, note: Callable[[str, float], None]) -> None:
        """Call before each round. `note` records why the run has waited, and for how long; it raises if it cannot."""
        if self._since_s is not None:
            waited_s = self.store.clock.monotonic_s() - self._since_s
            note(self._told, waited_s)
            self._since_s, self._told = None, ""
            self.operator.tell(f"the run goes on, after {waited_s:.0f} s")
