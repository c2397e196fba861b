"""What devices state about themselves: their identities, the camera bodies, what was exchanged. Pure.

Drivers of any version wrote these data, so every field may be missing; no value of another type is an error.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from service.core.records.events import DeviceOpened, DeviceTrouble, Event, OperatorAction, RecordedView
from service.core.records.optics import mapping_of, number_of, text_of


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
