"""Elementary changes of a RunState, from which the fold and the operator's actions are built."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from service.core.protocol.models import Protocol
from service.core.records.base import seconds_between
from service.core.records.events import Event
from service.core.run.lifecycle import ABORTED, COMPLETED, lifecycle
from service.core.run.state import Deviation, DeviationKind, RunState, Superseded

# What a step forgets when its work is done again.
UNMEASURED: Mapping[str, Any] = {
    "measures": {},
    "artefacts": (),
    "result": {},
    "uncertainties": {},
    "verdicts": (),
    "gates_passed": False,
    "gates_sha256": "",
    "accepted": None,
    "signed": False,
    "signed_by": "",
    "failure": None,
}
# What a step knows of waits for a person when the work of an attempt begins.
NOT_WAITING: Mapping[str, Any] = {"waits_since_utc": "", "waited_s": 0.0}


def wait(protocol: Protocol, state: RunState, event: Event) -> RunState:
    """Let the arm's work wait from now on for a person; work without an arm goes on meanwhile."""
    if not protocol.step(state.current).moves_robot or state.step.waits_since_utc:
        return state
    return change(state, state.current, waits_since_utc=event.at_utc)


def wait_no_more(state: RunState, event: Event) -> RunState:
    """Record that a person has let the work go on."""
    since_utc, waited_s = state.step.waits_since_utc, state.step.waited_s
    if not since_utc:
        return state
    waited_s += seconds_between(since_utc, event.at_utc)
    state = change(state, state.current, waits_since_utc="", waited_s=waited_s)
    return replace(state, last_view=("", ""))  # the time until the next one is not that of a view


def go(protocol: Protocol, state: RunState, trigger: str, **changes: Any) -> RunState:
    """Fire a trigger and apply `changes` to the step that the run was at. Raises IllegalTransitionError."""
    machine = lifecycle(protocol.step_ids)
    target = machine.next(state.machine_state, trigger)
    steps = {**state.steps, state.current: replace(state.step, **changes)}
    place = machine.place(target)
    if place is None:
        status = COMPLETED if target == COMPLETED else ABORTED
        return replace(state, machine_state=target, status=status, steps=steps)
    steps[place.step] = replace(steps[place.step], phase=place.phase)
    status = "paused" if place.paused else "active"
    return replace(state, machine_state=target, status=status, current=place.step, steps=steps)


def change(state: RunState, step: str, **changes: Any) -> RunState:
    """Replace fields of one step."""
    return replace(state, steps={**state.steps, step: replace(state.steps[step], **changes)})


def pass_on(protocol: Protocol, state: RunState) -> RunState:
    """Advance from a passed step to the next one; after the last step the run waits for run_completed."""
    return state if state.current == protocol.step_ids[-1] else go(protocol, state, "advance")


def supersede(
    state: RunState, event: Event, step: str, reason: str, viewpoint: str | None, captured: Mapping[str, int]
) -> RunState:
    """List an attempt, or one viewpoint of it, as superseded by `event`."""
    now = state.steps[step]
    past = Superseded(event.seq, step, now.attempt, reason, viewpoint, captured, began=bool(now.started_utc))
    return replace(state, superseded=(*state.superseded, past))


def deviate(state: RunState, event: Event, kind: DeviationKind, step: str | None, text: str) -> RunState:
    """List a deviation that `event` caused, or an automatic confirmation, which is none."""
    one = Deviation(event.seq, kind, step, text, event.actor)
    if kind == "automatic":
        return replace(state, automatic=(*state.automatic, one))
    return replace(state, deviations=(*state.deviations, one))
