"""How the clocks of devices and host stood against each other, by the record, and whether that will do: pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, Literal

from service.core.records.events import DeviceOpened, Event, SessionStarted, ViewpointCaptured

#: Limits. EXIF gives whole seconds, and a release takes part of one; of a network's time a host is a few ms off; two
#: good crystals go apart by up to 0.1 ms in a second, and the robot's messages come a few ms later or earlier.
DEVICE_LIMIT_S = 5.0
HOST_LIMIT_S = 1.0
_DRIFT_LIMIT_S, _DRIFT_LIMIT_RATE = 0.02, 2e-4

Against = Literal["host UTC", "host since it was opened", "NTP"]


@dataclass(frozen=True, slots=True)
class ClockReading:
    """One clock against another.

    Attributes:
        device: name in rig.yaml, or "host".
        against: with what it was compared. Where both count from power-on only the change since the opening counts.
        offset_s: how far it is ahead; None: not known.
        limit_s: that will do, either way.
        at_utc: when it was compared.
        note: what else is known of it.
    """

    device: str
    against: Against
    offset_s: float | None
    limit_s: float
    at_utc: str
    note: str = ""

    @property
    def within(self) -> bool | None:
        """Whether it will do; None: not known."""
        return None if self.offset_s is None else abs(self.offset_s) <= self.limit_s

    @property
    def name(self) -> str:
        """Whose clock it is, for people."""
        return "this machine" if self.device == "host" else self.device

    @property
    def other(self) -> str:
        """What it was compared with, for people."""
        return {"host UTC": "this machine", "NTP": "the network's time"}.get(self.against, "this machine, its change")

    @property
    def difference(self) -> str:
        """`1.250 s behind`; "–" where it is not known."""
        if self.offset_s is None:
            return "–"
        return f"{abs(self.offset_s):.3f} s {'ahead' if self.offset_s > 0 else 'behind'}"

    @property
    def meaning(self) -> str:
        """What its difference says and what rests on it, for whoever audits a run."""
        if self.against == "NTP":
            return "Every time in the record is this machine's: it is true as far as this clock is"
        if self.against == "host UTC":
            return "The time written in its files is its own. Order and times of the record do not rest on it"
        return (
            "It counts seconds from when the device was switched on, so how far it is from this machine's says "
            "nothing. Its change matters: by it the pose of the arm is found for the moment of each exposure"
        )

    @property
    def words(self) -> str:
        """For people, of a clock beyond its limit."""
        ahead = "ahead of" if (self.offset_s or 0.0) > 0 else "behind"
        other = "the network's" if self.against == "NTP" else "this machine's"
        what = f"The clock of {self.name} is {abs(self.offset_s or 0.0):.2f} s {ahead} {other}"
        if self.against == "host since it was opened":
            return f"{what}, counted from the first image: more than {self.limit_s:.2f} s. Look at its controller"
        return f"{what}: more than {self.limit_s:g} s. Set it, for the record's times are compared with it"


def offset_told(offset_s: float | None, clock: str) -> str:
    """A clock offset as a device reported it when it was opened. `clock`: utc, or uptime."""
    if clock == "uptime":
        return "counts from when it was switched on: only its change matters"
    if offset_s is None:
        return "not told"
    return f"{abs(offset_s):.3f} s {'ahead of' if offset_s > 0 else 'behind'} this machine's"


def clock_of(report: Mapping[str, Any]) -> str:
    """Which clock a recorded DeviceReport tells of, utc or uptime; an old record does not say: by the device."""
    kind = str((report.get("identity") or {}).get("kind", ""))
    return str(report.get("clock") or ("uptime" if kind == "robot" else "utc"))


def clock_readings(events: Sequence[Event]) -> tuple[ClockReading, ...]:
    """The newest of each clock that a run has recorded: the host's first, then in the order of the openings."""
    host: list[ClockReading] = []
    opened: dict[str, Event] = {}
    # The first image since the last opening of a device, and the newest: a run may have ten thousand.
    first: dict[str, Event] = {}
    newest: Event | None = None
    for event in events:
        payload = event.payload
        if isinstance(payload, ViewpointCaptured):
            newest = event
            for name in opened:
                first.setdefault(name, event)
        elif isinstance(payload, DeviceOpened):
            opened[payload.device] = event
            first.pop(payload.device, None)
        elif isinstance(payload, SessionStarted) and payload.host_clock is not None:
            clock = payload.host_clock
            note = "" if clock.synchronised else "not set by the network"
            host = [ClockReading("host", "NTP", clock.offset_s, HOST_LIMIT_S, event.at_utc, note)]
    kinds = Counter(_kind(event) for event in opened.values())
    # An event does not say which of several cameras or arms it is of.
    of_captures = {name for name, event in opened.items() if kinds[_kind(event)] == 1}
    found: list[ClockReading] = []
    for name, event in opened.items():
        since = (first[name], newest) if name in first and newest is not None and name in of_captures else None
        found += _readings(name, event, since)
    return (*host, *found)


def _kind(opened: Event) -> str:
    assert isinstance(opened.payload, DeviceOpened)
    return str((opened.payload.report.get("identity") or {}).get("kind", ""))


def _readings(name: str, opened: Event, captures: tuple[Event, Event] | None) -> list[ClockReading]:
    """Of one device, of its last opening and the first and newest image since."""
    assert isinstance(opened.payload, DeviceOpened)
    kind, report = _kind(opened), opened.payload.report
    if clock_of(report) == "uptime":
        return [_drift(name, opened, captures)]
    offset_s, at_utc = report.get("clock_offset_s"), opened.at_utc
    if kind == "camera" and captures is not None:
        of_image_s = _exif_offset_s(captures[1])
        if of_image_s is not None:
            offset_s, at_utc = of_image_s, captures[1].at_utc
    return [] if offset_s is None else [ClockReading(name, "host UTC", offset_s, DEVICE_LIMIT_S, at_utc)]


def _drift(name: str, opened: Event, captures: tuple[Event, Event] | None) -> ClockReading:
    if captures is None:
        note = "no image since it was opened"
        return ClockReading(name, "host since it was opened", None, _DRIFT_LIMIT_S, opened.at_utc, note)
    first, last = captures[0].payload, captures[1].payload
    assert isinstance(first, ViewpointCaptured)
    assert isinstance(last, ViewpointCaptured)
    over_s = max(0.0, last.trigger_monotonic_s - first.trigger_monotonic_s)
    limit_s = _DRIFT_LIMIT_S + _DRIFT_LIMIT_RATE * over_s
    drift_s = last.clock_offset_s - first.clock_offset_s
    return ClockReading(name, "host since it was opened", drift_s, limit_s, captures[1].at_utc)


def _exif_offset_s(event: Event) -> float | None:
    """Camera clock minus host UTC at the release; None where EXIF does not say its distance from UTC."""
    payload = event.payload
    assert isinstance(payload, ViewpointCaptured)
    try:
        stamp = datetime.strptime(str(payload.camera.get("exif_time", "")), "%Y:%m:%d %H:%M:%S.%f%z")
        recorded = datetime.fromisoformat(event.at_utc)
    except ValueError:
        return None
    released = recorded - timedelta(seconds=event.monotonic_s - payload.trigger_monotonic_s)
    return (stamp - released).total_seconds()
