"""One case of the matrix: what goes wrong, where, and what the person who is asked does about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from bench.torture.faults.proxy import AWAY_S, Spoil

Scene = Literal["arm", "camera", "lightbox", "scan", "ct", "store"]
BOUND_S = 240.0  # of a case, beyond the time that its device is away


@dataclass(frozen=True, slots=True)
class Case:
    """A row and a column of the matrix.

    Attributes:
        name: stable, `device/wire or state/what happens`; `--only` selects by it.
        scene: which small rig and protocol it runs on.
        what: what goes wrong, for people.
        spoil: of a message on a wire, by the proxy; None: the fault is the device's own.
        after: images that are in the record before the fault is armed; -1: it is armed from the start.
        faults: plan of the simulator (simulators/faults.py).
        options: further words for the simulator.
        act: name of what somebody or something does once armed (bench/torture/faults/acts.py).
        value: what the act needs to know.
        mend: name of what the person does before taking the first way on that the screen lists.
        patience: how many times the same question is answered before the person leaves it open.
        longer_s: what the program itself waits before it asks, beyond the bound of all cases.
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
        """No case may take longer."""
        if self.spoil is None:
            return BOUND_S + self.longer_s
        garbled_s = 120.0 if self.spoil.column in ("noise", "mutated") else 0.0  # every way on is tried, 60 s each
        return BOUND_S + (AWAY_S.get(self.spoil.column) or 0.0) + garbled_s + self.longer_s
