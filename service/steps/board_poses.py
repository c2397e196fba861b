"""Board poses as a protocol specifies them; loaded with every protocol, and so without OpenCV."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from service.compute.board.view_range import ViewRange
from service.core.records.events import Record


class BoardPoses(Record):
    """Board images that the software plans: how many, from where, and what they must reach."""

    station: str  # the station where the images are taken
    prefix: str  # the beginning of the views' names
    count: Annotated[int, Field(ge=4, le=300)]  # the number of images
    # Tilt of the camera from the vertical.
    tilts_deg: tuple[Annotated[float, Field(ge=0, le=60)], ...] = ViewRange().tilts_deg
    rolls_deg: tuple[float, ...] = ViewRange().rolls_deg  # the camera's angles about its axis
    # Distance from the camera to the board.
    distances_m: tuple[Annotated[float, Field(ge=0.2, le=2)], ...] = ViewRange().distances_m
    above_scene_m: float = 0.09  # approximate height of the board above the scene's centre
    long_side: Literal["across", "along"] = "across"  # the board's direction, seen from the robot
    place_tolerance_mm: Annotated[float, Field(gt=0, le=100)] = 30.0  # the tolerance of the board's centre
    turn_tolerance_deg: Annotated[float, Field(gt=0, le=30)] = 10.0  # tolerance of the turn about the vertical
    coverage: Annotated[float, Field(gt=0, le=1)] = 0.97  # share of the image area that the planned images must cover
    replacements: Annotated[int, Field(ge=0, le=100)] = 12  # most per attempt, for images without a board

    @property
    def wishes(self) -> ViewRange:
        """The range of board views, as the planner takes it."""
        return ViewRange(self.tilts_deg, self.rolls_deg, self.distances_m)
