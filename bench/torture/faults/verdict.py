"""What a case showed, and how it is read from the events of its run and from what a person saw."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from service.core.decide import AskOperator
from service.core.model import DeviceOpened, Event, StepFailed, ViewpointFailed

_DIGITS = re.compile(r"\d+(?:[.,]\d+)*")


@dataclass
class Verdict:
    """What a case showed.

    Attributes:
        name: of the case.
        reached: whether what was to go wrong did.
        broken: rules that do not hold, in words.
        policy: what was done about it, in order: `again` (the same viewpoint or step, at once), `reopen`, `retry`
            (of the step), `skip` (of a viewpoint), `ask`, `told` (and nothing stopped), `stop` (of the program).
        errors: classes of the errors, in order of their first appearance.
        words: on the screen.
        end: `completed`, or the ways on that are listed.
        events: kinds of the run's events and how many of each.
        seconds: of all of it.
    """

    name: str
    reached: bool = False
    broken: list[str] = field(default_factory=list[str])
    policy: list[str] = field(default_factory=list[str])
    errors: list[str] = field(default_factory=list[str])
    words: str = ""
    end: str = ""
    events: dict[str, int] = field(default_factory=dict[str, int])
    seconds: float = 0.0

    def told(self) -> dict[str, Any]:
        """For the file that the sweep reads."""
        return asdict(self)


def policy_of(events: Iterable[Event]) -> list[str]:
    """What was done, each kind where it came first."""
    done: list[str] = []
    opened: set[str] = set()
    for event in events:
        payload = event.payload
        if isinstance(payload, ViewpointFailed):
            done.append("skip" if payload.skipped else "again")
        elif isinstance(payload, StepFailed):
            done.append(payload.recovery)
        elif isinstance(payload, DeviceOpened):
            if payload.device in opened:
                done.append("reopen")
            opened.add(payload.device)
        elif payload.kind == "gates_evaluated" and not payload.passed:
            done.append("ask")
    return list(dict.fromkeys(done))


def errors_of(events: Iterable[Event]) -> list[str]:
    """Their classes, each where it came first."""
    return list(dict.fromkeys(e.payload.error for e in events if isinstance(e.payload, StepFailed | ViewpointFailed)))


def first_words(events: Iterable[Event], stopped: Iterable[AskOperator], printed: list[str]) -> str:
    """What a person read first about it, figures left out."""
    failed = [e.payload.message for e in events if isinstance(e.payload, StepFailed)]
    asked = [question.text for question in stopped]
    tried = [e.payload.message for e in events if isinstance(e.payload, ViewpointFailed)]
    return next(iter([*failed, *printed, *tried, *asked]), "")


def masked(words: str, folder: Path | None = None) -> str:
    """Words without what differs from run to run."""
    plain = words.replace(str(folder), "…") if folder is not None else words
    return _DIGITS.sub("N", " ".join(plain.split()))


def listed(question: AskOperator | None) -> str:
    """The ways on of the question that was left open; empty where there is none besides ending the run."""
    if question is None:
        return ""
    ways = [way.verb for way in question.ways if way.available and way.verb != "abort"]
    return f"waits: {', '.join(dict.fromkeys(ways))}" if ways else ""
