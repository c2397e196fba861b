"""Compares the settings that a protocol wants with those that rig.yaml states for a lens that software cannot set."""

from __future__ import annotations

from drivers.interfaces import CameraSettings

TOLERANCE = 0.02  # of aperture and exposure time, as for photographs


def differences(wanted: CameraSettings, stated: CameraSettings) -> tuple[str, ...]:
    """Each setting that differs, such as "f-number 22, not 4"; aperture and time may be off by TOLERANCE."""
    numbers = (
        ("f-number", wanted.aperture_f, stated.aperture_f),
        ("exposure time in s", wanted.exposure_s, stated.exposure_s),
        ("ISO", float(wanted.iso), float(stated.iso)),
    )
    words = ((wanted.focus_mode, stated.focus_mode), (wanted.image_quality, stated.image_quality))
    return (
        *(f"{name} {a:g}, not {b:g}" for name, a, b in numbers if abs(a - b) > TOLERANCE * b),
        *(f"{a}, not {b}" for a, b in words if a != b),
    )
