"""One case of the fault matrix: what goes wrong, where, and what the person does about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from tests.support.torture.faults.wire.proxy import AWAY_S, Spoil

Scene = Literal[
    "arm", "camera", "lightbox", "scan", "ct", "store", "table", "kuka", "video", "canon", "fri", "listen", "gige"
]
BOUND_S = 240.0  # limit for a case, in addition to the time that its device is away


@dataclass(frozen=True, slots=True)
class Case:
    """One cell of the fault matrix.

    Attributes:
        name: stable name, `device/wire or state/what happens`; `--only` selects by it.
        scene: the small rig and protocol on which it runs.
        what: description of the fault for people.
        spoil: message that the proxy spoils on a wire; None if the fault is the device's own.
        after: number of recorded images after which the fault is armed; -1: from the start.
        faults: fault plan of the simulator (simulators/faults.py).
        options: further options of the simulator.
        act: name of an act once the fault is armed (tests/support/torture/faults/acts.py).
        value: parameters of the act.
        mend: name of the person's repair before taking the first way on that the screen lists.
        patience: how often the same question is answered before the person leaves it open.
        longer_s: waiting time of the program itself before it asks, added to the bound.
    """

    name: str
    scene: Scene
    what: str
    spoil: Spoil | None = None
    after: int = -1
    faults: tuple[Mapping[str, Any], ...] = ()
    options: tuple[str, ...] = ()
    act: str = ""
    value: Mapping[str, Any] = field(default_factory=dict[str, Any])
    mend: str = ""
    patience: int = 3
    longer_s: float = 0.0

    @property
    def bound_s(self) -> float:
        """Time limit of the case."""
        if self.spoil is None:
            return BOUND_S + self.longer_s
        garbled_s = 120.0 if self.spoil.column in ("noise", "mutated") else 0.0  # every way on is tried, 60 s each
        return BOUND_S + (AWAY_S.get(self.spoil.column) or 0.0) + garbled_s + self.longer_s
