"""A host whose clock is set, that sleeps or restarts, and what is judged there by time."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

from service.core.errors import OrthocaptureError
from service.people.sessions import People
from service.store.durable_effects import SystemClock
from service.store.store import Store
from tests.support.pages.web import QUICK_HASHES, populate
from tests.support.record.stepped_clock import SteppedClock

_REBOOT_S, _HOUR_S = 600.0, 3600.0


@dataclass(frozen=True, slots=True)
class Fault:
    """Names what happens to the host's clocks in the middle of a wait."""

    name: str
    true_s: float = 0.0  # time that passes meanwhile
    set_s: float = 0.0  # by which UTC is set
    slew_ppm: float = 0.0  # by which UTC runs fast
    boot_monotonic_s: float | None = None  # with which the monotonic clock begins anew; None: no restart


FAULTS = (
    Fault("none"),
    Fault("reboot, 10 min off; monotonic time then smaller", _REBOOT_S, boot_monotonic_s=20.0),
    Fault("reboot, 10 min off; monotonic time then larger", _REBOOT_S, boot_monotonic_s=5e6),
    Fault("suspended for 1 h", _HOUR_S),
    Fault("set forward by 1 h", set_s=_HOUR_S),
    Fault("set back by 1 h", set_s=-_HOUR_S),
    Fault("fast by 500 ppm", slew_ppm=500.0),
    Fault("slow by 500 ppm", slew_ppm=-500.0),
)


@dataclass
class World:
    """A data folder with people, on such a host; a restart of the host ends every program."""

    folder: Path
    fault: Fault
    clock: SteppedClock = field(default_factory=SteppedClock.from_now)
    passed_s: float = 0.0  # true time since the beginning

    def __post_init__(self) -> None:
        self.began_utc_s = self.clock.utc_s()
        self.open()

    def open(self) -> None:
        """Start the programs."""
        self.store = Store.open(self.folder / "data", self.clock)
        self.people = People(self.store, QUICK_HASHES)
        populate(self.people)

    @property
    def true_utc_s(self) -> float:
        """Return what a right clock would show."""
        return self.began_utc_s + self.passed_s

    def wake(self, seconds: float) -> None:
        """Let time pass."""
        self.clock.passed_s += seconds
        self.clock.set_utc(seconds * 1e-6 * self.fault.slew_ppm)
        self.passed_s += seconds

    def strike(self, *, restart: bool = True) -> None:
        """Let the fault happen; `restart` is whether the programs are begun anew after a restart of the host."""
        fault = self.fault
        self.passed_s += fault.true_s
        if fault.boot_monotonic_s is None:
            self.clock.set_utc(fault.true_s + fault.set_s)
            return
        if restart:
            self.store.close()
        self.clock.reboot(fault.true_s, fault.boot_monotonic_s)
        if restart:
            self.open()

    def wait(self, true_s: float) -> None:
        """Let so much true time pass with the fault in the middle, or a second more than the fault lasts."""
        awake_s = max(1.0, true_s - self.fault.true_s)
        self.wake(awake_s / 2)
        self.strike()
        self.wake(awake_s / 2)


@contextmanager
def world(fault: Fault) -> Generator[World]:
    """A new host with this fault to come; its boots are those of the clock."""
    with TemporaryDirectory(prefix="clocks-") as folder:
        made = World(Path(folder), fault)
        with patch.object(SystemClock, "boot", lambda _self: made.clock.boot()):
            try:
                yield made
            finally:
                made.store.close()


@dataclass(frozen=True, slots=True)
class Seen:
    """Holds what the program did after a wait.

    Attributes:
        allows: whether it allowed what it judges by time.
        did: in words.
        took_s: for how long it took the wait; None where it states no number.
    """

    allows: bool
    did: str
    took_s: float | None = None


@dataclass(frozen=True, slots=True)
class Duration:
    """A duration that a gate or a timer judges.

    Attributes:
        name: of the duration.
        limit_s: at which the judgement changes.
        allowed: with a wait of this many seconds that right clocks measure, is it allowed?
        if_refused: what follows from refusing too much: the safe side; "" if refusing is the unsafe one.
        if_allowed: what follows from allowing too much; "" if that is unsafe.
        see: begin it in a world, let the time pass and see what the program does.
    """

    name: str
    limit_s: float
    allowed: Callable[[float], bool]
    see: Callable[[World, float], Seen]
    if_refused: str = ""
    if_allowed: str = ""


@dataclass(frozen=True, slots=True)
class Row:
    """One wait under one fault, and the verdict."""

    duration: str
    limit_s: float
    fault: str
    true_s: float
    took_s: float | None
    did: str
    verdict: str


def below(limit_s: float) -> Callable[[float], bool]:
    """Allowed up to a limit."""
    return lambda true_s: true_s <= limit_s


def above(limit_s: float) -> Callable[[float], bool]:
    """Allowed from a limit on."""
    return lambda true_s: true_s >= limit_s


def allows(act: Callable[[], object]) -> bool:
    """Return whether the program allows this."""
    try:
        act()
    except OrthocaptureError:
        return False
    return True


def rows_of(duration: Duration, fault: Fault) -> list[Row]:
    """Wait for a little less and a little more than the limit, or as little more as the fault lasts."""
    near_s = min(0.1 * duration.limit_s, 600.0)
    limits_s = (duration.limit_s - near_s, duration.limit_s + near_s)
    waits = dict.fromkeys(max(limit_s, fault.true_s + 1.0) for limit_s in limits_s)
    return [_row(duration, fault, true_s) for true_s in waits]


def _row(duration: Duration, fault: Fault, true_s: float) -> Row:
    with world(fault) as host:
        seen = duration.see(host, true_s)
    verdict = "right"
    if seen.allows != duration.allowed(true_s):
        safe = duration.if_allowed if seen.allows else duration.if_refused
        verdict = f"safe side: {safe}" if safe else "WRONG"
    return Row(duration.name, duration.limit_s, fault.name, true_s, seen.took_s, seen.did, verdict)
