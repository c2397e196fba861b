"""What images, and viewpoints without one, do to the state."""

from __future__ import annotations

from dataclasses import replace

from service.core.protocol.models import Protocol
from service.core.records.events import CaptureAsked, Event, RecordedView, ViewImported, ViewpointFailed
from service.core.records.moments import seconds_between
from service.core.run.effects.place import is_void_now, require_running, without_effect
from service.core.run.persistent_map import put
from service.core.run.state import FailedTries, RunState
from service.core.run.state_transitions import change, deviate, supersede

_VIEWS_TIMED = 30  # number of latest views whose median gap estimates the time per view


def _with_view(state: RunState, event: Event, step: str) -> RunState:
    """Record the time since the step's previous view, for the latest views only."""
    there, at_utc = state.last_view
    gaps = state.view_gaps_s
    if there == step:
        gaps = (*gaps, seconds_between(at_utc, event.at_utc))[-_VIEWS_TIMED:]
    return replace(state, view_gaps_s=gaps, last_view=(step, event.at_utc))


def capture_asked(protocol: Protocol, state: RunState, event: Event, p: CaptureAsked) -> RunState:
    """Note what was asked of a manual capture; a request that comes too late has no effect."""
    if state.terminal or (p.step, p.attempt, "running") != (state.current, state.step.attempt, state.phase):
        return without_effect(state, event)
    return change(state, p.step, asked=(*state.step.asked, p.what))


def view_added(protocol: Protocol, state: RunState, event: Event, p: RecordedView) -> RunState:
    """Count an image; of two with the same name within an attempt, the later one."""
    if is_void_now(state, event, p.step, p.attempt):
        return without_effect(_among_the_superseded(state, event, p), event)
    require_running(state, event)
    state = _with_view(state, event, p.step)
    now = state.step
    if p.viewpoint in now.captured:  # taken again within the attempt: the later one counts
        earlier = {p.viewpoint: now.captured[p.viewpoint]}
        again = "imported again" if isinstance(p, ViewImported) else "captured again"
        state = supersede(state, event, p.step, again, p.viewpoint, earlier)
    return change(
        state,
        p.step,
        captured=put(now.captured, p.viewpoint, event.seq),
        skipped_viewpoints=tuple(name for name in now.skipped_viewpoints if name != p.viewpoint),
        failures=0,
        tries=None,
    )


def _among_the_superseded(state: RunState, event: Event, p: RecordedView) -> RunState:
    """Add an image that arrived after its attempt was replaced to the superseded images of that attempt."""
    listed = [
        replace(past, captured=put(past.captured, p.viewpoint, event.seq))
        if (past.step, past.attempt, past.viewpoint) == (p.step, p.attempt, None)
        else past
        for past in state.superseded
    ]
    return replace(state, superseded=tuple(listed))


def viewpoint_failed(protocol: Protocol, state: RunState, event: Event, p: ViewpointFailed) -> RunState:
    """Count a failure of a viewpoint, which may be given up."""
    if is_void_now(state, event, p.step, p.attempt):
        return without_effect(state, event)
    require_running(state, event)
    now = state.step
    counts = put(now.viewpoint_failures, p.viewpoint, now.viewpoint_failures.get(p.viewpoint, 0) + 1)
    given_up, tries = now.skipped_viewpoints, now.tries
    if p.skipped and p.viewpoint not in given_up:
        given_up = (*given_up, p.viewpoint)
        state = deviate(state, event, "viewpoint_skipped", p.step, f"{p.viewpoint} given up: {p.message}")
    if not p.skipped:
        tries = FailedTries(p.viewpoint, counts[p.viewpoint], p.message, event.at_utc)
    return change(state, p.step, viewpoint_failures=counts, skipped_viewpoints=given_up, tries=tries)
