"""The clock of a coat that disappears: its age, and how long the scan that needs it may still take."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime, timedelta

from service.core.protocol import Protocol, Step
from service.core.records.base import Elapsed, Moment, elapsed
from service.core.run.state import RunState
from service.steps.kinds import scan_import, timed_application

_SHOWN_S = 60.0  # the time left is shown in whole minutes
_CLOSE_S, _SHOWN_CLOSE_S = 300.0, 10.0  # and in steps of ten seconds when there is little of it


@dataclass(frozen=True, slots=True)
class Coat:
    """A coat on the specimen, while a scan of it is still to come.

    Attributes:
        product: the name of what was applied.
        scan: the title of the step that imports the scan.
        within_s: the age at which the scan must have arrived: the limit of that step's gate, else of the application.
        gated: true if a gate of the protocol judges the age.
        sublimates_after_s: the age at which it has disappeared.
        age: the age as the gate will judge it; not known where the clocks contradict each other.
        at_utc: the time for which this holds.
    """

    product: str
    scan: str
    within_s: float
    gated: bool
    sublimates_after_s: float
    age: Elapsed
    at_utc: str

    @property
    def left_s(self) -> float | None:
        """Seconds until the limit, negative after it; None where the age is not known."""
        return None if self.age.seconds is None else self.within_s - self.age.seconds

    @property
    def due_utc(self) -> str:
        """The time of the limit, ISO 8601; "" where the age is not known."""
        if self.left_s is None:
            return ""
        due = datetime.fromisoformat(self.at_utc) + timedelta(seconds=self.left_s)
        return due.isoformat().replace("+00:00", "Z")

    @property
    def title(self) -> str:
        """The time left as a short text."""
        left_s = self.left_s
        if left_s is None:
            return f"Coat of {self.product}: how old it is cannot be known."
        if left_s > 0:
            return f"Coat of {self.product}: {_left(left_s)} left."
        return f"Coat of {self.product}: {_over(-left_s)} too old."

    @property
    def text(self) -> str:
        """The consequence of the coat's age for the scan, as a sentence."""
        limit = f"{self.within_s / 60:g} min"
        if self.age.seconds is None:
            then = f" The limit of {limit} will not count as met." if self.gated else ""
            return f"{self.age.why[:1].upper()}{self.age.why[1:]}.{then}"
        if self.age.seconds >= self.sublimates_after_s:
            return f"It has disappeared after {self.sublimates_after_s / 3600:g} h."
        judged = "the protocol's limit" if self.gated else "the time that the protocol states"
        aged = f"It was applied {math.floor(self.age.seconds / 60)} min ago"
        if self.left_s is not None and self.left_s <= 0:
            return f"{aged}; {judged} for “{self.scan}” is {limit}."
        return f"{aged}; the export for “{self.scan}” has to arrive within {limit}."


def coats(protocol: Protocol, state: RunState, now: Moment) -> tuple[Coat, ...]:
    """Return the coats that are on the specimen while the scan that needs them has not passed."""
    if state.terminal:
        return ()
    found: list[Coat] = []
    for step in protocol.steps:
        if not isinstance(step.params, timed_application.Params):
            continue
        applied = timed_application.applied_at(state.steps[step.id].notes)
        scan = _scan_of(protocol, step)
        if applied is None or scan is None or state.steps[scan.id].phase == "passed":
            continue
        limit_s = _limit_s(scan)
        found.append(
            Coat(
                product=step.params.product,
                scan=scan.title,
                within_s=step.params.scan_within_s if limit_s is None else limit_s,
                gated=limit_s is not None,
                sublimates_after_s=step.params.sublimates_after_s,
                age=elapsed(applied, now),
                at_utc=now.at_utc,
            )
        )
    return tuple(found)


def _scan_of(protocol: Protocol, application: Step) -> Step | None:
    """Return the step that imports the scan of a coat: the one that names it, else the next one."""
    later = protocol.steps[protocol.index(application.id) + 1 :]
    scans = [(step, step.params) for step in later if isinstance(step.params, scan_import.Params)]
    named = [step for step, params in scans if params.application == application.id]
    return next(iter([*named, *(step for step, params in scans if params.application is None)]), None)


def _limit_s(scan: Step) -> float | None:
    """Return the largest age that the step's gate allows; None without such a gate."""
    if not isinstance(scan.params, scan_import.Params) or scan.params.application is None:
        return None
    limits = [gate.max for gate in scan.gates if gate.measure == scan_import.AGE and gate.max is not None]
    return 60.0 * min(limits) if limits else None


def _left(seconds: float) -> str:
    """Return `33 min`, and `4 min 10 s` when it is little; never more than is left."""
    if seconds >= _CLOSE_S:
        return f"{math.floor(seconds / _SHOWN_S)} min"
    shown_s = int(math.floor(seconds / _SHOWN_CLOSE_S) * _SHOWN_CLOSE_S)
    return f"{shown_s // 60} min {shown_s % 60:02d} s" if shown_s >= 60 else f"{shown_s} s"


def _over(seconds: float) -> str:
    return f"{max(math.ceil(seconds / _SHOWN_S), 1)} min"
