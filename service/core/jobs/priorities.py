"""Which job goes first: what a person looks at, what a step waits for, and last what nobody waits for."""

from __future__ import annotations

from typing import Literal

LIVE = 0  # a person watches the answer come while the arm moves
WAITED = 1  # a step goes on when it is done
EARLY = 10  # prepared while the images arrive
LATER = 20  # arrives after the decision and holds nothing up
REDUCED = 30  # for a comparison in a table

Lane = Literal["waited", "background"]


def lane_of(priority: int) -> Lane:
    """Whether a step or a person waits for a job, or nobody does."""
    return "waited" if priority < EARLY else "background"
