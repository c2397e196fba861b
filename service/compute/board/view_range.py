"""The range of viewing directions and distances from which a board is to be photographed."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ViewRange:
    """The wanted range of views of the board."""

    tilts_deg: tuple[float, ...] = (4.0, 14.0, 24.0, 32.0, 38.0)  # of the optical axis from the board's normal
    rolls_deg: tuple[float, ...] = (0.0, 12.0, -12.0, 180.0, 168.0, 192.0)  # of the image about the optical axis
    distances_m: tuple[float, ...] = (0.62, 0.68, 0.74)
    azimuths: int = 16
