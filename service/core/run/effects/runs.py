"""What the events of a run as a whole do to its state."""

from __future__ import annotations

from dataclasses import replace

from service.core.protocol.models import Protocol
from service.core.records.events import (
    Event,
    FilesKept,
    RunAborted,
    RunCompleted,
    RunStarted,
    SessionStarted,
)
from service.core.run.actions import needs_leave
from service.core.run.effects.arms import connections_ended
from service.core.run.effects.place import impossible, is_void, triggered, without_effect
from service.core.run.state import RunState
from service.core.run.state_transitions import change


def run_started(protocol: Protocol, state: RunState, event: Event, p: RunStarted) -> RunState:
    """The run begins, with its operator."""
    if (p.protocol_id, p.protocol_version) != (protocol.id, protocol.version):
        raise impossible(event, f"the run is of protocol {p.protocol_id} {p.protocol_version}, not of the given one")
    return replace(
        state,
        run_id=event.run_id,
        operator=p.operator,
        simulated=p.simulated,
        origin=p.origin,
        auto_confirm=p.auto_confirm,
        people=frozenset({p.operator}),
    )


def session_started(protocol: Protocol, state: RunState, event: Event, p: SessionStarted) -> RunState:
    """The runner began or resumed; a resumed run needs a new leave to move, and its arms count as moving."""
    state = connections_ended(state, event) if p.resumed else state
    state = replace(state, sessions=state.sessions + 1, restarted=p.resumed, leave=None if p.resumed else state.leave)
    # Whoever lets the robot move again must check again: the ticks were made before the program ended.
    return change(state, state.current, ticked=()) if needs_leave(protocol, state) else state


def files_kept(protocol: Protocol, state: RunState, event: Event, p: FilesKept) -> RunState:
    """Files were kept for a step: no effect on the state."""
    return without_effect(state, event) if is_void(state, event, p.step, p.attempt) else state


def run_completed(protocol: Protocol, state: RunState, event: Event, p: RunCompleted) -> RunState:
    """The last step has passed, and the run ends."""
    done = state.current == protocol.step_ids[-1] and state.phase == "passed"
    if state.terminal or not done:
        redone_just_before = state.last_redo_seq == state.seq
        if state.status == "aborted" or redone_just_before:
            return without_effect(state, event)
        raise impossible(event, f"the run is {state.status} at {state.current}, {state.phase}")
    completed = triggered(protocol, state, event, "advance")
    return replace(completed, completed_sha256=event.sha256, ended_utc=event.at_utc)


def run_aborted(protocol: Protocol, state: RunState, event: Event, p: RunAborted) -> RunState:
    """The run ends early."""
    if state.status == "aborted":  # the runner's own record of an operator's abort
        return replace(state, stop_reason=state.stop_reason or p.reason)
    return replace(triggered(protocol, state, event, "abort"), stop_reason=p.reason)
