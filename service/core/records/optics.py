"""Camera, lens and settings as a photograph states them, read from the field `camera` of a recorded photograph.

Drivers of any version, bodies of any maker and other people's files wrote that field: any key may be missing, unknown
or of another type, and an event must keep it as it is, because its hash was signed. So the field stays plain JSON,
and it is read here and nowhere else (docs/decisions/0021-what-a-photograph-states.md).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

Plain = Mapping[str, object]


@dataclass(frozen=True, slots=True)
class RecordedOptics:
    """Camera, lens and settings as a photograph states them; "" or None: not given."""

    make: str = ""
    model: str = ""
    body_serial: str = ""
    lens: str = ""
    lens_serial: str = ""
    focal_length_mm: float | None = None
    aperture_f: float | None = None
    exposure_s: float | None = None
    iso: float | None = None
    focus_mode: str = ""
    focus_distance_m: float | None = None
    focus_position: int | None = None  # of the focus motor, in its own steps
    width: int | None = None
    height: int | None = None
    exif_time: str = ""
    unread: str = ""  # what could not be read of the file's EXIF


def recorded_optics(camera: object) -> RecordedOptics:
    """Return what the `camera` of a recorded photograph states.

    Zero stands for a number that the camera does not know. Only the focus motor has a position zero.
    """
    fields = mapping_of(camera)
    focus_position = number_of(fields.get("focus_position"))
    return RecordedOptics(
        make=text_of(fields.get("make")),
        model=text_of(fields.get("model")),
        body_serial=text_of(fields.get("body_serial")),
        lens=text_of(fields.get("lens")),
        lens_serial=text_of(fields.get("lens_serial")),
        focal_length_mm=number_of(fields.get("focal_length_mm")) or None,
        aperture_f=number_of(fields.get("aperture_f")) or None,
        exposure_s=number_of(fields.get("exposure_s")) or None,
        iso=number_of(fields.get("iso")) or None,
        focus_mode=text_of(fields.get("focus_mode")),
        focus_distance_m=number_of(fields.get("focus_distance_m")) or None,
        focus_position=None if focus_position is None else int(focus_position),
        width=int(number_of(fields.get("width")) or 0) or None,
        height=int(number_of(fields.get("height")) or 0) or None,
        exif_time=text_of(fields.get("exif_time")),
        unread=text_of(fields.get("unread")),
    )


def mapping_of(value: object) -> Plain:
    """Return a recorded JSON object; an empty one in place of any other value."""
    return cast("Plain", value) if isinstance(value, Mapping) else {}


def text_of(value: object) -> str:
    """Return a recorded value as text; "" where nothing was given."""
    return "" if value is None else str(value)


def number_of(value: object) -> float | None:
    """Return a recorded number; None in place of any other value."""
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
