"""One serial number for each camera body, though connection and photographs may state different ones. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from service.core.equipment.recorded_devices import RecordedIdentity, recorded_optics, recorded_report
from service.core.records.events import DeviceOpened, Event, RecordedView


@dataclass(frozen=True, slots=True)
class CameraBodies:
    """The serial numbers of a run's cameras.

    Attributes:
        wires: serial number that a camera states over its connection → device name in rig.yaml. Over USB a camera may
            put digits of its model before those of the body.
        stated: the distinct serial numbers that the photographs state.
    """

    wires: Mapping[str, str]
    stated: tuple[str, ...]

    def shown(self, identity: RecordedIdentity) -> str:
        """The serial number to show for a device: for a camera that of the body, as its photographs state it."""
        return self._own(identity.serial) if identity.kind == "camera" else identity.serial

    def _own(self, wire: str) -> str:
        return next((number for number in self.stated if wire and _same(wire, number)), wire)

    @property
    def explained(self) -> tuple[str, ...]:
        """One sentence for each camera that is shown under another number than it states over its connection."""
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
    """The serial numbers in a run's events."""
    opened = [event.payload for event in events if isinstance(event.payload, DeviceOpened)]
    views = (event.payload for event in events if isinstance(event.payload, RecordedView))
    identities = ((payload.device, recorded_report(payload.report).identity) for payload in opened)
    return bodies_of(identities, (recorded_optics(view.camera).body_serial for view in views))


def bodies_of(identities: Iterable[tuple[str, RecordedIdentity]], stated: Iterable[str]) -> CameraBodies:
    """The serial numbers of cameras.

    Args:
        identities: (name in rig.yaml, identity in its DeviceReport) of each opened device.
        stated: serial numbers in the photographs; "" is ignored.
    """
    wires = {identity.serial: name for name, identity in identities if identity.kind == "camera"}
    return CameraBodies(wires, tuple(dict.fromkeys(number for number in stated if number)))


def _same(one: str, other: str) -> bool:
    a, b = one.lstrip("0"), other.lstrip("0")
    return bool(a and b) and (a.endswith(b) or b.endswith(a))
