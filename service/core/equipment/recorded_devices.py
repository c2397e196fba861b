"""What devices and photographs state about themselves, read from the plain data of recorded events. Pure.

Drivers of any version wrote these data, so every field may be missing; no value of another type is an error.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, cast

Plain = Mapping[str, object]


@dataclass(frozen=True, slots=True)
class RecordedIdentity:
    """The device that answered when it was opened (drivers.interfaces.DeviceIdentity); "" where it was not stated."""

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
        details: what else it says of itself, by name.
    """

    identity: RecordedIdentity
    clock_offset_s: float | None
    clock: Literal["utc", "uptime"]
    details: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class RecordedOptics:
    """Camera, lens and settings that a photograph states (the field `camera` of a View); "" or None: not stated."""

    model: str = ""
    body_serial: str = ""
    lens: str = ""
    lens_serial: str = ""
    focal_length_mm: float | None = None
    aperture_f: float | None = None
    focus_mode: str = ""
    exif_time: str = ""


def recorded_identity(stated: object) -> RecordedIdentity:
    """The identity in a recorded DeviceReport; all fields are "" if there is none."""
    fields = _mapping(stated)
    return RecordedIdentity(
        kind=_text(fields.get("kind")),
        model=_text(fields.get("model")),
        serial=_text(fields.get("serial")),
        firmware=_text(fields.get("firmware")),
        driver=_text(fields.get("driver")),
        driver_version=_text(fields.get("driver_version")),
        address=_text(fields.get("address")),
    )


def recorded_report(report: object) -> RecordedReport:
    """The `report` of a device_opened event."""
    fields = _mapping(report)
    identity = recorded_identity(fields.get("identity"))
    stated = fields.get("clock") or ("uptime" if identity.kind == "robot" else "utc")
    clock = "uptime" if stated == "uptime" else "utc"
    details = {name: str(value) for name, value in _mapping(fields.get("details")).items()}
    return RecordedReport(identity, _number(fields.get("clock_offset_s")), clock, details)


def recorded_optics(camera: object) -> RecordedOptics:
    """The `camera` of a view's event. Zero stands for a length or f-number that the camera does not know."""
    fields = _mapping(camera)
    return RecordedOptics(
        model=_text(fields.get("model")),
        body_serial=_text(fields.get("body_serial")),
        lens=_text(fields.get("lens")),
        lens_serial=_text(fields.get("lens_serial")),
        focal_length_mm=_number(fields.get("focal_length_mm")) or None,
        aperture_f=_number(fields.get("aperture_f")) or None,
        focus_mode=_text(fields.get("focus_mode")),
        exif_time=_text(fields.get("exif_time")),
    )


def _mapping(value: object) -> Plain:
    return cast("Plain", value) if isinstance(value, Mapping) else {}


def _text(value: object) -> str:
    return "" if value is None else str(value)


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
