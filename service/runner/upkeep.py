"""What a runner looks after besides the steps: clocks, disk space, memory, signatures, and trouble of its own."""

from __future__ import annotations

import dataclasses
import gc
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from drivers.errors import DeviceError
from service.core.disk_space import Forecast, Verdict
from service.core.errors import IntegrityError, StoreError
from service.core.protocol import Protocol
from service.core.recorded_devices import clock_readings
from service.core.records.run_events import DeviceTrouble, StepNote
from service.followed_run import RunFollower
from service.runner.held_run import HeldRun, Operator
from service.steps.context import Devices
from service.store.disk_space import forecast_of, require_space
from service.store.records import LeaseHeldError, LeaseLostError, RecordDamagedError
from service.store.signatures.second_place import Away, SecondPlace, away_words
from service.store.signatures.signing import checkpoint
from service.store.signatures.timestamps import Authority, stamp_end
from service.store.store import Store


@dataclass(frozen=True)
class ClockWatch:
    """Checks the recorded clock offsets and reports those beyond their limits."""

    follower: RunFollower
    tell: Callable[[str], None]
    _told: set[str] = field(init=False, default_factory=set[str])

    def look(self) -> None:
        """Report each clock beyond its limit that has not been reported yet."""
        for reading in clock_readings(self.follower.now().events):
            if reading.within is False and reading.device not in self._told:
                self._told.add(reading.device)
                self.tell(reading.words)


_FORECAST_EVERY_S = 30.0
_LOOK_EVERY_S = 2.0  # in this time a camera cannot fill the space that is reserved


@dataclass
class DiskWatch:
    """Forecasts whether the disk has room for the rest of the run; records and reports a forecast that is worse."""

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
        """Make a forecast; record it and report it to the operator if it is worse than the one before."""
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


# During a full collection no other thread of the process runs, not even the heartbeat without which a moving arm is
# stopped after 0.2 s. A full collection visits every object in memory, and the runner keeps the events of its run:
# its collections became longer with every viewpoint.
@contextmanager
def short_collections() -> Generator[None]:
    """Let full collections in this block visit only what was made since the one before.

    What was there before, or survives a full collection, is not visited again. It is still freed when its last
    reference goes; only a cycle that becomes garbage later stays in memory, until the end of the block.
    """
    gc.freeze()
    gc.callbacks.append(_keep_survivors)
    try:
        yield
    finally:
        gc.callbacks.remove(_keep_survivors)
        gc.unfreeze()


def _keep_survivors(phase: str, collection: dict[str, Any]) -> None:
    if phase == "stop" and collection["generation"] == 2:
        gc.freeze()


_DEVICE = "second place of signatures"


@dataclass
class Seal:
    """Signs the chain of one run, and keeps the second place of the signatures up to date.

    `authority`, if given, stamps the run's end. `busy` and `tell` are the operator's methods.
    """

    store: Store
    run_id: str
    authority: Authority | None
    second_place: SecondPlace
    busy: Callable[[str], None]
    tell: Callable[[str], None]
    _away: Away | None = None  # as the record says it

    def sign(self, *, ended: bool) -> None:
        """Sign the chain's end and, if the run has `ended`, have the signature stamped.

        A failure is reported to the operator; nothing is raised: the next signature covers the same events.
        """
        self.busy("signing the record")
        try:
            stamp_end(self.store, self.run_id, self.authority if ended else None)
        except StoreError as error:
            resume = f"`orthocapture resume {self.run_id}` signs it"
            self.tell(f"the record could not be signed: {error}. Once that is put right, {resume}")
        away = self.second_place.update()
        if (away is None) != (self._away is None):
            self._tell_of_the_place(away)

    def _tell_of_the_place(self, away: Away | None) -> None:
        """Inform the operator, and record that the second place is away; a run goes on without it."""
        self._away = away
        if away is None:
            self.tell("the second place of the signatures is up to date again")
            return
        self.tell(away_words(away))
        trouble = DeviceTrouble(device=_DEVICE, error="Away", message=f"{away.place}: {away.why}")
        try:
            self.store.record(self.run_id, [trouble], actor="service")
            checkpoint(self.store, self.run_id)
        except StoreError as error:
            self.tell(f"that could not be recorded: {error}")

    def sign_if_missing(self) -> None:
        """Sign and stamp an ended run whose runner died before it could, or whose authority did not answer."""
        if self.authority is None or not self.store.timestamps(self.run_id):
            self.sign(ended=True)


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
