"""Forecast whether the disk has room for a run, from what is planned and what was written. Pure.

The last LEAST_FREE_BYTES are reserved for the evidence: no logs and no new photographs are written into them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from service.core.protocol import Protocol
from service.core.recovery import planned_views
from service.core.run.state import RunState
from service.core.units import gigabytes, megabytes

LEAST_FREE_BYTES = 1 << 30
_VIEWS_UNDER_WAY = 5  # need room above LEAST_FREE_BYTES: in the camera, in transfer or being computed
_ENOUGH_VIEWS = 3  # with this many, a run's own figures are used
_MANUAL_VIEWS = 60  # typical number of a manual capture, which plans none
# Used when no run has been recorded yet: JPEG and RAW of 60 MP with what is computed from them; less when simulated.
_GUESSED_VIEW_BYTES, _GUESSED_SIMULATED_BYTES = 100_000_000, 4_000_000
_GUESSED_OTHER_BYTES = 1_000_000_000  # CT, scans, registered data

Verdict = Literal["enough", "short", "stop"]


@dataclass(frozen=True, slots=True)
class Usage:
    """Recorded sizes of a run's files."""

    views: int = 0
    view_bytes: int = 0  # photographs, with RAW and pose logs
    computed_bytes: int = 0  # what jobs wrote
    other_bytes: int = 0  # CT, scans, protocol …


@dataclass(frozen=True, slots=True)
class Forecast:
    """The bytes that a run will still write, and those that are free."""

    views_left: int
    view_bytes: int  # one view, with what is computed from it
    needed_bytes: int  # to the end of the run
    free_bytes: int
    known_from: Literal["this run", "an earlier run", "a guess"]

    @property
    def stop_below_bytes(self) -> int:
        """Free space below which no further photograph is started."""
        return LEAST_FREE_BYTES + _VIEWS_UNDER_WAY * self.view_bytes

    @property
    def begins_from_bytes(self) -> int:
        """Free space from which new work begins."""
        return min(self.stop_below_bytes, LEAST_FREE_BYTES + self.needed_bytes)

    @property
    def verdict(self) -> Verdict:
        """`stop`: no new work begins. `short`: the space will run out before the end of the run."""
        if self.free_bytes < self.begins_from_bytes:
            return "stop"
        return "short" if self.free_bytes - self.needed_bytes < LEAST_FREE_BYTES else "enough"

    @property
    def words(self) -> str:
        """The figures and what they mean, in a sentence."""
        views = f"{self.views_left} views of {megabytes(self.view_bytes):.0f} MB each, from {self.known_from}"
        figures = f"{size_words(self.free_bytes)} are free, and the run needs about {size_words(self.needed_bytes)}"
        figures += f" more ({views})" if self.views_left else " more"
        if self.verdict == "enough":
            return f"Disk: {figures}"
        if self.verdict == "short":
            return f"The disk is too small: {figures}; {self.reserve}"
        return (
            f"The disk of the data folder is nearly full: {figures}; {self.reserve}. Nothing begins until "
            f"{size_words(self.begins_from_bytes)} are free"
        )

    @property
    def reserve(self) -> str:
        """One sentence on the space that stays free."""
        return f"the last {size_words(LEAST_FREE_BYTES)} are kept free, so that work under way can be recorded"


def forecast(
    protocol: Protocol, state: RunState | None, here: Usage, before: Usage | None, free_bytes: int, *, simulated: bool
) -> Forecast:
    """Forecast what a run will still write.

    Args:
        protocol: the run's protocol.
        state: the run's state; None before it begins.
        here: the sizes of its files so far.
        state: the run's state; None before it begins.
        free_bytes: free space on the disk of the data folder.
        simulated: true for a simulated rig.
    """
    known = before if before is not None and before.views >= _ENOUGH_VIEWS else None
    own = here if here.views >= _ENOUGH_VIEWS else None
    guess = _GUESSED_SIMULATED_BYTES if simulated else _GUESSED_VIEW_BYTES
    source = own or known
    photograph = guess if source is None else source.view_bytes / source.views
    # Jobs lag behind their views, so early in a run what they wrote is too small an estimate.
    computed = max((u.computed_bytes / u.views for u in (own, known) if u is not None), default=0.0)
    other = known.other_bytes if known is not None else (0 if simulated else _GUESSED_OTHER_BYTES)
    left = views_left(protocol, state)
    needed = left * photograph
    needed += max(0.0, computed * (here.views + left) - here.computed_bytes)
    needed += max(0, other - here.other_bytes)
    if state is not None and state.terminal:
        left, needed = 0, 0.0
    known_from: Literal["this run", "an earlier run", "a guess"] = (
        "this run" if own is not None else "an earlier run" if known is not None else "a guess"
    )
    return Forecast(left, round(photograph + computed), round(needed), free_bytes, known_from)


def views_left(protocol: Protocol, state: RunState | None) -> int:
    """Return the number of photographs that the protocol plans and that are not taken yet."""
    left = 0
    for step in protocol.steps:
        now = None if state is None else state.steps[step.id]
        if now is not None and (now.phase == "passed" or now.skipped):
            continue
        planned = _MANUAL_VIEWS if step.by_hand else planned_views(step)
        left += max(0, planned - (0 if now is None else len(now.captured)))
    return left


def size_words(size_bytes: float) -> str:
    """Return a size as text, such as `850 MB` or `12.3 GB`."""
    return f"{gigabytes(size_bytes):.1f} GB" if size_bytes >= 1e9 else f"{megabytes(size_bytes):.0f} MB"
