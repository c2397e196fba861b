"""What devices state about themselves: identities, camera bodies, what was exchanged, their clocks. Pure.

Drivers of any version wrote these data, so every field may be missing; no value of another type is an error.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from statistics import fmean, stdev
from typing import Literal

from service.core.records.events import Event
from service.core.records.run_events import (
    DeviceOpened,
    DeviceTrouble,
    FurtherExposure,
    OperatorAction,
    RecordedView,
    SessionStarted,
    ViewpointCaptured,
    mapping_of,
    number_of,
    text_of,
)
from service.core.words import counted


@dataclass(frozen=True, slots=True)
class RecordedIdentity:
    """The device that answered when it was opened (drivers.interfaces.DeviceIdentity); "" where it was not given."""

    kind: str = ""  # robot, camera, scanner, ct, lightbox
    model: str = ""
    serial: str = ""
    firmware: str = ""
    driver: str = ""
    driver_version: str = ""
    address: str = ""


@dataclass(frozen=True, slots=True)
class RecordedReport:
    """The report of a device when it was opened (drivers.interfaces.DeviceReport).

    Attributes:
        identity: the device.
        clock_offset_s: device clock minus host UTC, or minus host monotonic for an uptime clock; None: not reported.
        clock: uptime: it counts from power-on. Old records do not say; there the kind of device decides.
        details: further statements of the device about itself, by name.
    """

    identity: RecordedIdentity
    clock_offset_s: float | None
    clock: Literal["utc", "uptime"]
    details: Mapping[str, str]


def recorded_identity(stated: object) -> RecordedIdentity:
    """Return the identity in a recorded DeviceReport; all fields are "" if there is none."""
    fields = mapping_of(stated)
    return RecordedIdentity(
        kind=text_of(fields.get("kind")),
        model=text_of(fields.get("model")),
        serial=text_of(fields.get("serial")),
        firmware=text_of(fields.get("firmware")),
        driver=text_of(fields.get("driver")),
        driver_version=text_of(fields.get("driver_version")),
        address=text_of(fields.get("address")),
    )


def recorded_report(report: object) -> RecordedReport:
    """Return the `report` of a device_opened event."""
    fields = mapping_of(report)
    identity = recorded_identity(fields.get("identity"))
    stated = fields.get("clock") or ("uptime" if identity.kind == "robot" else "utc")
    clock = "uptime" if stated == "uptime" else "utc"
    details = {name: str(value) for name, value in mapping_of(fields.get("details")).items()}
    return RecordedReport(identity, number_of(fields.get("clock_offset_s")), clock, details)


@dataclass(frozen=True, slots=True)
class CameraBodies:
    """The serial numbers of a run's cameras.

    Attributes:
        wires: the device's name in rig.yaml, by the serial number that a camera sends over its connection. Over USB a
            camera may put digits of its model before those of the body.
        stated: the distinct serial numbers in the photographs.
    """

    wires: Mapping[str, str]
    stated: tuple[str, ...]

    def shown(self, identity: RecordedIdentity) -> str:
        """Return the serial number to show for a device: for a camera its body's, as its photographs state it."""
        return self._own(identity.serial) if identity.kind == "camera" else identity.serial

    def _own(self, wire: str) -> str:
        return next((number for number in self.stated if wire and _same(wire, number)), wire)

    @property
    def explained(self) -> tuple[str, ...]:
        """One sentence for each camera that is shown under another number than it reports over its connection."""
        return tuple(
            f"The serial number of {device} is {self._own(wire)}, as every photograph of it states. Over its "
            f"connection it states {wire}, which ends with the same digits: it is one and the same body"
            for wire, device in self.wires.items()
            if self._own(wire) != wire
        )

    @property
    def strange(self) -> str:
        """A sentence on photographs whose serial number belongs to none of the opened cameras; "" without any."""
        known = [wire for wire in self.wires if wire]
        others = [number for number in self.stated if not any(_same(wire, number) for wire in known)]
        if not known or not others:
            return ""
        return (
            f"Photographs state the serial number {' and '.join(others)}, and no camera that was opened does: "
            f"{', '.join(f'{self.wires[wire]} states {wire}' for wire in known)}. They are of another body"
        )


def bodies(events: Sequence[Event]) -> CameraBodies:
    """Return the serial numbers in a run's events."""
    opened = [event.payload for event in events if isinstance(event.payload, DeviceOpened)]
    views = (event.payload for event in events if isinstance(event.payload, RecordedView))
    identities = ((payload.device, recorded_report(payload.report).identity) for payload in opened)
    return bodies_of(identities, (view.optics.body_serial for view in views))


def bodies_of(identities: Iterable[tuple[str, RecordedIdentity]], stated: Iterable[str]) -> CameraBodies:
    """Return the serial numbers of cameras.

    Args:
        identities: (name in rig.yaml, identity in its DeviceReport) of each opened device.
        stated: the serial numbers in the photographs; "" is ignored.
    """
    wires = {identity.serial: name for name, identity in identities if identity.kind == "camera"}
    return CameraBodies(wires, tuple(dict.fromkeys(number for number in stated if number)))


def _same(one: str, other: str) -> bool:
    a, b = one.lstrip("0"), other.lstrip("0")
    return bool(a and b) and (a.endswith(b) or b.endswith(a))


CHANGED = "DeviceChangedError"  # the name under which it is recorded
# Nothing is calibrated with these: that one was exchanged is said and recorded, and nobody is asked.
NOT_CALIBRATED = frozenset({"lightbox", "ct"})
_DECIDES = frozenset({"confirm", "redo", "skip"})


def exchanged(events: Iterable[Event], device: str, opened: RecordedIdentity) -> RecordedIdentity | None:
    """Return the device that a run has used so far under this name in the rig file; None if it is the one opened now.

    A device without a serial number is identified by its model. Another one is the run's own if it answers after
    a person who was asked about it has decided to go on.

    Args:
        events: the run's events before this opening.
        device: its name in the rig file.
        opened: the device that answered.
    """
    own: RecordedIdentity | None = None
    other: RecordedIdentity | None = None  # that answered last, instead of it
    asked = decided = False  # about that one; a person who decided may have put either in place
    for event in events:
        match event.payload:
            case DeviceOpened(device=name, report=report) if name == device:
                found = recorded_report(report).identity
                if own is None or (decided and other is not None and _same_device(other, found)):
                    own = found
                if _same_device(own, found):
                    other, asked, decided = None, False, False
                elif other is None or not _same_device(other, found):
                    other, asked, decided = found, False, False
            case DeviceTrouble(device=name, error=error) if name == device and error == CHANGED:
                asked = True
                decided = other is not None and other.kind in NOT_CALIBRATED
            case OperatorAction(action=action) if asked and action in _DECIDES:
                decided = True
            case _:
                pass
    if own is None or _same_device(own, opened) or (decided and other is not None and _same_device(other, opened)):
        return None
    return own


def exchanged_words(device: str, before: RecordedIdentity, now: RecordedIdentity) -> str:
    """Return `camera is another camera: it has the serial number 5678, the one before had 1234`."""
    if now.serial and before.serial:
        what = f"it has the serial number {now.serial}, the one before had {before.serial}"
    else:
        what = f"it is a {now.model}, the one before was a {before.model}"
    return f"{device} is another {now.kind or 'device'}: {what}"


def _same_device(one: RecordedIdentity, other: RecordedIdentity) -> bool:
    if one.serial and other.serial:
        return one.serial == other.serial
    return not one.model or not other.model or one.model == other.model


_UNLIKE_S = 0.1  # sigma of the difference between two models' delays, from the command to the exposure
_FORMS = ("%Y:%m:%d %H:%M:%S.%f%z", "%Y:%m:%d %H:%M:%S.%f", "%Y:%m:%d %H:%M:%S%z", "%Y:%m:%d %H:%M:%S")


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """The mean offset of a further camera's clock.

    Attributes:
        offset_s: the further camera's clock minus the first one's.
        sigma_s: the standard deviation of the mean, by the scatter of the photographs, or by the resolution of their
            times if that is more; for cameras of two models it includes what their delays may differ by.
        photographs: the number of pairs of photographs whose times are recorded alike.
        unlike: true if the cameras are of two models.
    """

    offset_s: float
    sigma_s: float
    photographs: int
    unlike: bool = False


def clock_offset(captures: Sequence[ViewpointCaptured], device: str) -> ClockOffset | None:
    """Return the offset of a further camera's clock from the first one's; None if no photographs have times.

    Between the two exposures at a viewpoint the host's clock says how much time passed. What the times in both
    photographs differ from that is the offset. A difference between the cameras' delays, from the command to
    the exposure, is part of it. Two bodies of one model have the same delay. Those of two models may differ by some
    tenths of a second, which no number of photographs averages out.
    """
    pairs = [(c, exposure) for c in captures for exposure in c.further if exposure.device == device]
    found = [offset for capture, exposure in pairs if (offset := _of_pair(capture, exposure)) is not None]
    if not found:
        return None
    offsets = [offset for offset, _ in found]
    coarse_s = max(resolution for _, resolution in found) / math.sqrt(6)  # two rounded times, each r / sqrt(12)
    scatter_s = stdev(offsets) if len(offsets) > 1 else 0.0
    sigma_s = max(coarse_s, scatter_s) / math.sqrt(len(offsets))
    unlike = any(capture.optics.model != one.optics.model for capture, one in pairs)
    return ClockOffset(fmean(offsets), math.hypot(sigma_s, _UNLIKE_S if unlike else 0.0), len(offsets), unlike)


def _of_pair(capture: ViewpointCaptured, exposure: FurtherExposure) -> tuple[float, float] | None:
    """Return offset and resolution of the recorded times, in seconds."""
    first, second = (_time(stated.optics.exif_time) for stated in (capture, exposure))
    if first is None or second is None or (first[0].tzinfo is None) != (second[0].tzinfo is None):
        return None
    stated_s = (second[0] - first[0]).total_seconds()
    return stated_s - (exposure.trigger_monotonic_s - capture.trigger_monotonic_s), max(first[1], second[1])


def _time(stated: str) -> tuple[datetime, float] | None:
    """Parse the time in a photograph's EXIF; return it and its resolution in seconds."""
    for form in _FORMS:
        try:
            found = datetime.strptime(stated, form)  # noqa: DTZ007 - compared only with one that has no zone either
        except ValueError:
            continue
        _, _, after = stated.partition(".")
        digits = len(after) - len(after.lstrip("0123456789"))
        return found, 10.0**-digits
    return None


#: Limits. EXIF times may be whole seconds, and a release takes part of one. A host synchronised over the network is a
#: few ms off. Two good crystals drift apart by up to 0.1 ms per second, and robot messages jitter by a few ms.
DEVICE_LIMIT_S = 5.0
HOST_LIMIT_S = 1.0
_COMPARED = 100  # newest pairs of photographs by which two cameras' clocks are compared
_DRIFT_LIMIT_S, _DRIFT_LIMIT_RATE = 0.02, 2e-4

Against = Literal["host UTC", "host since it was opened", "NTP", "first camera"]


@dataclass(frozen=True, slots=True)
class ClockReading:
    """The offset of one clock from another.

    Attributes:
        device: name in rig.yaml, or "host".
        against: the clock it was compared with. For a device that counts from power-on only the change of the offset
            since the device was opened is given.
        offset_s: its lead over the other clock; None if not known.
        limit_s: largest acceptable absolute offset.
        at_utc: the time of the comparison.
        note: anything else that is known about the offset.
    """

    device: str
    against: Against
    offset_s: float | None
    limit_s: float
    at_utc: str
    note: str = ""

    @property
    def within(self) -> bool | None:
        """True if the offset is within its limit; None if the offset is not known."""
        return None if self.offset_s is None else abs(self.offset_s) <= self.limit_s

    @property
    def name(self) -> str:
        """The name of the clock's owner, for people."""
        return "this machine" if self.device == "host" else self.device

    @property
    def other(self) -> str:
        """The name of the clock that it was compared with, for people."""
        others = {"host UTC": "this machine", "NTP": "the network's time", "first camera": "the first camera"}
        return others.get(self.against, "this machine, its change")

    @property
    def difference(self) -> str:
        """The offset as text, such as `1.250 s behind`; "–" if it is not known."""
        if self.offset_s is None:
            return "–"
        return f"{abs(self.offset_s):.3f} s {'ahead' if self.offset_s > 0 else 'behind'}"

    @property
    def meaning(self) -> str:
        """The meaning of the offset and what depends on it, for the auditor of a run."""
        if self.against == "NTP":
            return "Every time in the record is from this machine's clock and is as true as this clock"
        if self.against == "first camera":
            return "With it, the times in the files of both cameras can be compared. The poses do not depend on it"
        if self.against == "host UTC":
            return "It sets the times in the device's own files. Order and times of the record do not depend on it"
        return (
            "It counts seconds since the device was switched on, so its distance from this machine's clock means "
            "nothing. Its drift matters: the arm's pose at the moment of each exposure is found with it"
        )

    @property
    def words(self) -> str:
        """A sentence for people on a clock beyond its limit, with what to do."""
        ahead = "ahead of" if (self.offset_s or 0.0) > 0 else "behind"
        other = {"NTP": "the network's", "first camera": "the first camera's"}.get(self.against, "this machine's")
        what = f"The clock of {self.name} is {abs(self.offset_s or 0.0):.2f} s {ahead} {other}"
        if self.against == "host since it was opened":
            return f"{what}, counted from the first image: more than {self.limit_s:.2f} s. Check its controller"
        return f"{what}: more than {self.limit_s:g} s. Set it: times in the record are compared with it"


def clock_offset_words(offset_s: float | None, clock: Literal["utc", "uptime"]) -> str:
    """Return as text the clock offset that a device reported when it was opened."""
    if clock == "uptime":
        return "counts from when it was switched on: only its drift matters"
    if offset_s is None:
        return "not reported"
    return f"{abs(offset_s):.3f} s {'ahead of' if offset_s > 0 else 'behind'} this machine's"


def clock_readings(events: Sequence[Event]) -> tuple[ClockReading, ...]:
    """Return the newest reading of every clock in a run: the host's first, then devices as they were opened."""
    host: list[ClockReading] = []
    opened: dict[str, Event] = {}
    # Only the first image since a device was last opened, and the newest: a run may have ten thousand.
    first: dict[str, Event] = {}
    newest: Event | None = None
    both: list[ViewpointCaptured] = []  # the newest with images of further cameras
    for event in events:
        payload = event.payload
        if isinstance(payload, ViewpointCaptured):
            newest = event
            if payload.further:
                both = [*both[1 - _COMPARED :], payload]
            for name in opened:
                first.setdefault(name, event)
        elif isinstance(payload, DeviceOpened):
            opened[payload.device] = event
            first.pop(payload.device, None)
        elif isinstance(payload, SessionStarted) and payload.host_clock is not None:
            clock = payload.host_clock
            note = "" if clock.synchronised else "not set by the network"
            host = [ClockReading("host", "NTP", clock.offset_s, HOST_LIMIT_S, event.at_utc, note)]
    reports = {name: _report(event) for name, event in opened.items()}
    further = {exposure.device for capture in both for exposure in capture.further}
    # A capture does not say from which of several arms, or of several first cameras, it came.
    kinds = Counter(report.identity.kind for name, report in reports.items() if name not in further)
    of_captures = {n for n, report in reports.items() if n not in further and kinds[report.identity.kind] == 1}
    found: list[ClockReading] = []
    for name, event in opened.items():
        since = (first[name], newest) if name in first and newest is not None and name in of_captures else None
        found += _readings(name, event, reports[name], since)
        if name in further and newest is not None:
            found += _against_the_first(name, both, newest.at_utc)
    return (*host, *found)


def _against_the_first(device: str, captures: Sequence[ViewpointCaptured], at_utc: str) -> list[ClockReading]:
    """Return how far a further camera's clock is ahead of the first camera's, by the newest photographs."""
    found = clock_offset(captures, device)
    if found is None:
        return []
    note = f"± {found.sigma_s:.3f} s, by {counted(found.photographs, 'pair')} of photographs"
    if found.unlike:
        note += "; two models, whose delays from command to exposure differ"
    return [ClockReading(device, "first camera", found.offset_s, DEVICE_LIMIT_S, at_utc, note)]


def _report(opened: Event) -> RecordedReport:
    assert isinstance(opened.payload, DeviceOpened)
    return recorded_report(opened.payload.report)


def _readings(
    name: str, opened: Event, report: RecordedReport, captures: tuple[Event, Event] | None
) -> list[ClockReading]:
    """Return the readings of one device from its last opening and the first and newest image since."""
    if report.clock == "uptime":
        return [_drift(name, opened, captures)]
    offset_s, at_utc = report.clock_offset_s, opened.at_utc
    if report.identity.kind == "camera" and captures is not None:
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
    """Return the camera's clock minus host UTC at the release, in seconds; None if EXIF has no offset from UTC."""
    payload = event.payload
    assert isinstance(payload, ViewpointCaptured)
    try:
        stamp = datetime.strptime(payload.optics.exif_time, "%Y:%m:%d %H:%M:%S.%f%z")
        recorded = datetime.fromisoformat(event.at_utc)
    except ValueError:
        return None
    released = recorded - timedelta(seconds=event.monotonic_s - payload.trigger_monotonic_s)
    return (stamp - released).total_seconds()
