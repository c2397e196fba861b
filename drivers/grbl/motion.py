"""A straight motion as short jogs, handed over only a moment ahead: without its host the machine soon stands."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from drivers.grbl import AHEAD_S, PIECE_S
from drivers.grbl.wire import jog
from service.core.geometry import Array

_BLOCKS = 10  # of the 15 that GRBL's planner holds
ARRIVED = 0.02  # degrees or millimetres; positions are rounded to 0.001 and to whole steps


@dataclass
class Motion:
    """A motion in machine coordinates (N,), degrees and millimetres.

    Attributes:
        letters: the axes' letters.
        start: the positions of the axes at its beginning.
        target: the positions of the axes at its end.
        duration_s: the time that it takes at full speed; GRBL adds its own acceleration.
        braking_s: braking distance, as the time that it takes at full speed.
    """

    letters: tuple[str, ...]
    start: Array
    target: Array
    duration_s: float
    braking_s: float
    sent: float = field(init=False, default=0.0)  # fraction of the way that was handed over

    @property
    def all_sent(self) -> bool:
        """Return whether the last piece was handed over."""
        return self.sent >= 1.0

    def next_piece(self, position: Array) -> bytes | None:
        """The next line to send when the axes are at `position` (N,); None if enough was sent."""
        ahead_s = AHEAD_S + self.braking_s
        if self.all_sent or (self.sent - self._share_of_way(position)) * self.duration_s >= ahead_s:
            return None
        piece = max(PIECE_S, ahead_s / _BLOCKS) / self.duration_s
        self.sent = 1.0 if self.sent + 1.5 * piece >= 1.0 else self.sent + piece
        length = float(np.linalg.norm(self.target - self.start))
        return jog(self.letters, self._at(self.sent).tolist(), 60.0 * length / self.duration_s)

    def stands_at_its_end(self, position: Array) -> bool:
        """Return whether the axes are where the last piece that was sent ends."""
        return bool(np.all(np.abs(position - self._at(self.sent)) <= ARRIVED))

    def _at(self, fraction: float) -> Array:
        return self.start + fraction * (self.target - self.start)

    def _share_of_way(self, position: Array) -> float:
        way = self.target - self.start
        return float(np.clip((position - self.start) @ way / (way @ way), 0.0, 1.0))
