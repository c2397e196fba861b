"""Compares settings with those that a protocol wants: of photographs, and of lenses that software cannot set."""

from __future__ import annotations

from drivers.interfaces import CameraSettings

TOLERANCE = 0.02  # relative: cameras round apertures and exposure times


def agrees(value: float, wanted: float) -> bool:
    """Return whether an aperture or an exposure time is the wanted one, up to rounding."""
    return abs(value - wanted) <= TOLERANCE * wanted


def differences(wanted: CameraSettings, stated: CameraSettings) -> tuple[str, ...]:
    """Each setting that differs, such as "f-number 22, not 4"; aperture and time as in `agrees`."""
    numbers = (
        ("f-number", wanted.aperture_f, stated.aperture_f),
        ("exposure time in s", wanted.exposure_s, stated.exposure_s),
    )
    words = ((wanted.focus_mode, stated.focus_mode), (wanted.image_quality, stated.image_quality))
    return (
        *(f"{name} {a:g}, not {b:g}" for name, a, b in numbers if not agrees(a, b)),
        *([] if wanted.iso == stated.iso else [f"ISO {wanted.iso:g}, not {stated.iso:g}"]),
        *(f"{a}, not {b}" for a, b in words if a != b),
    )
