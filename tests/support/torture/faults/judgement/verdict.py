"""The result of a case, read from the events of its run and from what a person saw."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from service.core.records.events import Event
from service.core.records.run_events import DeviceOpened, StepFailed, ViewpointFailed
from service.core.run.decide import AskOperator

_DIGITS = re.compile(r"\d+(?:[.,]\d+)*")


@dataclass
class Verdict:
    """The result of a case.

    Attributes:
        name: of the case. reached: whether the fault occurred. broken: violated rules, as sentences. policy: the
        reactions in order: `again` (the same viewpoint or step, at once), `reopen`, `retry` (of the step),
            `skip` (of a viewpoint), `ask`, `told` (and nothing stopped), `stop` (of the program).
        errors: classes of the errors, in order of first appearance.
        words: on the screen.
        end: `completed`, or the ways on that are listed.
        events: kinds of the run's events with their counts.
        seconds: total duration.
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
        """Convert to JSON data for the file that the sweep reads."""
        return asdict(self)


def policy_of(events: Iterable[Event]) -> list[str]:
    """The reactions, each kind at its first occurrence."""
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
    """The classes of the errors, each at its first occurrence."""
    return list(dict.fromkeys(e.payload.error for e in events if isinstance(e.payload, StepFailed | ViewpointFailed)))


def first_words(events: Iterable[Event], stopped: Iterable[AskOperator], printed: list[str]) -> str:
    """The first words about the fault that a person read, without figures."""
    failed = [e.payload.message for e in events if isinstance(e.payload, StepFailed)]
    asked = [question.text for question in stopped]
    tried = [e.payload.message for e in events if isinstance(e.payload, ViewpointFailed)]
    return next(iter([*failed, *printed, *tried, *asked]), "")


def masked(words: str, folder: Path | None = None) -> str:
    """Replace everything in the words that varies from run to run."""
    plain = words.replace(str(folder), "…") if folder is not None else words
    return _DIGITS.sub("N", " ".join(plain.split()))


def listed(question: AskOperator | None) -> str:
    """The ways on of an open question; empty if the only one is to end the run."""
    if question is None:
        return ""
    ways = [way.verb for way in question.ways if way.available and way.verb != "abort"]
    return f"waits: {', '.join(dict.fromkeys(ways))}" if ways else ""
