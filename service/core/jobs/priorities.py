"""Job priorities: first what a person is watching, then what a step waits for, last what nobody waits for."""

from __future__ import annotations

from typing import Literal

LIVE = 0  # shown to a person while the arm moves
WAITED = 1  # a step waits for it
EARLY = 10  # prepared while the images arrive
LATER = 20  # arrives after the decision and holds nothing up
REDUCED = 30  # reduced resolutions, only for comparison in a table

Lane = Literal["waited", "background"]


def lane_of(priority: int) -> Lane:
    """`waited` if a step or a person waits for jobs of this priority, else `background`."""
    return "waited" if priority < EARLY else "background"
