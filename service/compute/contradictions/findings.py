"""What a registration shows of faults in its inputs, in words, with what to do about each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

ContradictionKind = Literal[
    "image left out", "images contradict", "sphere not found", "spheres not found", "focal length",
    "principal point", "scale", "size of outlines", "blur",
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Contradiction:
    """One fault.

    Attributes:
        kind: of fault.
        what: is wrong, in a sentence without its full stop.
        remedy: what to do; where the data cannot tell causes apart, one for each.
        refuses: whether the result must not be used before somebody has looked at this.
    """

    kind: ContradictionKind
    what: str
    remedy: str
    refuses: bool = False
