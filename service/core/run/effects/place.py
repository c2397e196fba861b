"""Decides whether an event takes effect at its place in the chain, or was overtaken by another, or is impossible."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from service.core.errors import IllegalTransitionError, IntegrityError
from service.core.protocol.models import Protocol
from service.core.records.events import Event
from service.core.run.state import RunState
from service.core.run.state_transitions import go


def impossible(event: Event, why: str) -> IntegrityError:
    """The error for an event that cannot have happened in its place."""
    return IntegrityError(
        f"{event.payload.kind} cannot have happened here: {why}",
        where=f"run {event.run_id} event {event.seq}",
        remedy="Run `orthocapture audit verify` on this run; do not continue it",
    )


def triggered(protocol: Protocol, state: RunState, event: Event, trigger: str, **changes: Any) -> RunState:
    """The state after a trigger of the lifecycle. Raises IntegrityError if it is not allowed now."""
    try:
        return go(protocol, state, trigger, **changes)
    except IllegalTransitionError as error:
        raise impossible(event, str(error)) from error


def without_effect(state: RunState, event: Event) -> RunState:
    """Note that an event has no effect on the state; it stays in the evidence."""
    return replace(state, overtaken=(*state.overtaken, event.seq))


def is_void(state: RunState, event: Event, step: str, attempt: int, *, when_completed: bool = False) -> bool:
    """Whether an operator's redo, skip or abort was recorded before the outcome of the work.

    The web and the command line append actions while the runner works, so such events are legitimate; they stay in
    the evidence without effect. With `when_completed`, the work may still be recorded after the run was completed.
    Raises IntegrityError for work that was never due.
    """
    if step not in state.steps:
        raise impossible(event, f"the protocol has no step {step!r}")
    there = state.steps[step]
    ended = state.status == "aborted" if when_completed else state.terminal
    if attempt < there.attempt or ended or (there.skipped and attempt == there.attempt):
        return True
    if attempt > there.attempt:
        raise impossible(event, f"attempt {attempt} of {step} has not begun; it is at {there.attempt}")
    return False


def is_void_now(state: RunState, event: Event, step: str, attempt: int) -> bool:
    """`is_void` for events that only the current step can produce. Raises IntegrityError for another step."""
    if is_void(state, event, step, attempt):
        return True
    if step != state.current:
        raise impossible(event, f"the run is at {state.current}")
    return False


def require_running(state: RunState, event: Event) -> None:
    """Raise IntegrityError unless the current step is running."""
    if state.phase != "running":
        raise impossible(event, f"{state.current} is {state.phase}, not running")
