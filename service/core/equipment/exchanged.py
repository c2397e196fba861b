"""Whether a device that is opened again is the one that a run has used so far, by its serial number. Pure."""

from __future__ import annotations

from collections.abc import Iterable

from service.core.equipment.recorded_devices import RecordedIdentity, recorded_report
from service.core.records.events import DeviceOpened, DeviceTrouble, Event, OperatorAction

CHANGED = "DeviceChangedError"  # the name under which it is recorded
# Nothing is calibrated with these: that one was exchanged is said and recorded, and nobody is asked.
NOT_CALIBRATED = frozenset({"lightbox", "ct"})
_DECIDES = frozenset({"confirm", "redo", "skip"})


def exchanged(events: Iterable[Event], device: str, opened: RecordedIdentity) -> RecordedIdentity | None:
    """The device that a run has used so far under this name in the rig file; None if it is the one opened now.

    A device that states no serial number is told by its model. Another one is the run's own if it answers after
    a person who was asked about it has decided to go on.

    Args:
        events: of the run, before this opening.
        device: name in the rig file.
        opened: what answered.
    """
    own: RecordedIdentity | None = None
    other: RecordedIdentity | None = None  # that answered last, instead of it
    asked = decided = False  # about that one; a person who decided may have put either in place
    for event in events:
        match event.payload:
            case DeviceOpened(device=name, report=report) if name == device:
                found = recorded_report(report).identity
                if own is None or (decided and other is not None and _same(other, found)):
                    own = found
                if _same(own, found):
                    other, asked, decided = None, False, False
                elif other is None or not _same(other, found):
                    other, asked, decided = found, False, False
            case DeviceTrouble(device=name, error=error) if name == device and error == CHANGED:
                asked = True
                decided = other is not None and other.kind in NOT_CALIBRATED
            case OperatorAction(action=action) if asked and action in _DECIDES:
                decided = True
            case _:
                pass
    if own is None or _same(own, opened) or (decided and other is not None and _same(other, opened)):
        return None
    return own


def exchanged_words(device: str, before: RecordedIdentity, now: RecordedIdentity) -> str:
    """`camera is another camera: it has the serial number 5678, the one before had 1234`."""
    if now.serial and before.serial:
        what = f"it has the serial number {now.serial}, the one before had {before.serial}"
    else:
        what = f"it is a {now.model}, the one before was a {before.model}"
    return f"{device} is another {now.kind or 'device'}: {what}"


def _same(one: RecordedIdentity, other: RecordedIdentity) -> bool:
    if one.serial and other.serial:
        return one.serial == other.serial
    return not one.model or not other.model or one.model == other.model
