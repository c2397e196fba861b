"""What people's entries do to the state, except the actions of operator_transitions.py."""

from __future__ import annotations

from dataclasses import replace

from service.core.gates.release import refuse_release
from service.core.protocol.models import Protocol
from service.core.records.events import (
    ActionRefused,
    ControlTaken,
    Event,
    ItemTicked,
    RecordCorrected,
    RegionDrawn,
    RunReleased,
)
from service.core.run.actions import needs_leave
from service.core.run.effects.place import without_effect
from service.core.run.state import Correction, DrawnRegion, RunState
from service.core.run.state_transitions import change, deviate


def action_refused(protocol: Protocol, state: RunState, event: Event, p: ActionRefused) -> RunState:
    """List a refused action as a deviation."""
    return deviate(state, event, "refused", p.step, f"{p.action} refused: {p.why}")


def item_ticked(protocol: Protocol, state: RunState, event: Event, p: ItemTicked) -> RunState:
    """Tick or untick an item; no effect if it comes too late or the protocol has no such item."""
    asked = state.phase in ("ready", "recovering") or needs_leave(protocol, state)
    open_now = asked and (p.step, p.attempt) == (state.current, state.step.attempt)
    if state.terminal or not open_now:
        return without_effect(state, event)
    items = [item for item in protocol.step(p.step).checklist if item in state.step.ticked and item != p.item]
    if p.ticked and p.item in protocol.step(p.step).checklist:
        items.append(p.item)
    return change(state, p.step, ticked=tuple(items))


def control_taken(protocol: Protocol, state: RunState, event: Event, p: ControlTaken) -> RunState:
    """Another screen controls the run, or none."""
    controller = event.actor if p.screen else ""
    return replace(state, controller=controller, people=state.people | {event.actor})


def record_corrected(protocol: Protocol, state: RunState, event: Event, p: RecordCorrected) -> RunState:
    """List a correction of the record."""
    correction = Correction(event.seq, p.of_seq, p.field, p.old, p.new, p.reason, event.actor)
    return replace(state, corrections=(*state.corrections, correction))


def run_released(protocol: Protocol, state: RunState, event: Event, p: RunReleased) -> RunState:
    """A person releases the run, if that is allowed."""
    refusal = refuse_release(state, event.actor, p.signed_sha256)
    if refusal is not None:
        return deviate(state, event, "refused", None, f"release had no effect: {refusal}")
    return replace(state, released_by=event.actor)


def region_drawn(protocol: Protocol, state: RunState, event: Event, p: RegionDrawn) -> RunState:
    """Keep it for the next fusion; a region drawn after the end of the run has no effect."""
    if state.terminal:
        return without_effect(state, event)
    return replace(state, drawn=(*state.drawn, DrawnRegion(event.seq, event.actor, p)))
