"""The connections to the arms of a run as its events tell of them: which were lost, and who has looked since."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from service.core.run.state import RunState


@dataclass(frozen=True, slots=True)
class Loss:
    """The end of a connection to an arm, after which nobody has looked at it yet."""

    seq: int  # of the newest event that tells of it: what a person answers
    since_utc: str  # of the first loss since somebody looked
    how: str  # in words that follow a time: `when its driver's process ended (died of SIGKILL)`


@dataclass(frozen=True, slots=True)
class ArmConnection:
    """What the record says of the connection to one arm. An arm whose connection was lost counts as moving.

    Attributes:
        connected: whether it was opened, and no later event says that the connection has ended.
        loss: set until a person has looked.
        lost_utc: when a connection to it was lost last; "" if none was.
        refused_utc: when it could not be connected; "" once it was.
        refused_why: what the driver said then.
        seen_by: who has looked at it since it was lost.
        seen_utc: when.
    """

    connected: bool = False
    loss: Loss | None = None
    lost_utc: str = ""
    refused_utc: str = ""
    refused_why: str = ""
    seen_by: str = ""
    seen_utc: str = ""


NO_ARM = ArmConnection()
ENDINGS: Mapping[str, str] = {
    "died": "when its driver's process ended",
    "stalled": "when its driver no longer answered",
    "broken": "when the arm no longer answered its driver",
    "program": "when the program that drives the run ended",
}


def lost_arms(state: RunState) -> dict[str, Loss]:
    """The arms that count as moving because a connection was lost and nobody has looked since, by name."""
    return {name: arm.loss for name, arm in state.arms.items() if arm.loss is not None}


def connected_arms(state: RunState) -> tuple[str, ...]:
    """The arms to which a connection is open, as far as the record knows."""
    return tuple(name for name, arm in state.arms.items() if arm.connected)
