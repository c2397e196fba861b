"""What a profile says of a scanner's exports: formats, unit, and how its views are laid out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class ScanProfile:
    """The exports of one scanner, or of one family that exports alike.

    Attributes:
        scanner: its maker and model.
        software: the program that exports.
        units: the unit of each format that is read, by the extension in lower case. A file whose size contradicts it
            is refused, never scaled. E57 is in metres by its standard.
        advice: the setting to choose in that program, for messages.
        views: sizes (columns, rows) of a single view that is exported as points in the order of the sensor's pixels,
            row by row; empty if the program exports meshes only. In a view's frame the sensor is at the origin and
            looks along +z; points that were not measured are not finite or exactly zero.
    """

    scanner: str
    software: str
    units: Mapping[str, Literal["mm", "m"]]
    advice: str
    views: tuple[tuple[int, int], ...] = ()

    @property
    def suffixes(self) -> tuple[str, ...]:
        """The extensions of the files that are read."""
        return tuple(self.units)
