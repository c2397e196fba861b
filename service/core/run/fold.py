"""Events → RunState, as a pure reduction: the same events always give the same state, also after a restart."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

from service.core.protocol.models import Protocol
from service.core.records.entered import NoteTaken
from service.core.records.events import (
    ActionRefused,
    CaptureAsked,
    ControlTaken,
    DeviceOpened,
    DeviceTrouble,
    Event,
    EvidenceExported,
    FilesKept,
    GatesEvaluated,
    ItemTicked,
    JobEnqueued,
    JobFailed,
    JobFinished,
    LeaveLapsed,
    OperatorAction,
    RecordCorrected,
    RegionDrawn,
    RobotSeen,
    RunAborted,
    RunCompleted,
    RunReleased,
    RunStarted,
    SessionStarted,
    StepFailed,
    StepMeasured,
    StepNote,
    StepPassed,
    StepRetried,
    StepStarted,
    ViewHeld,
    ViewImported,
    ViewpointCaptured,
    ViewpointFailed,
)
from service.core.run.effects.arms import device_opened, device_trouble, leave_lapsed, robot_seen
from service.core.run.effects.jobs import job_ended, job_enqueued
from service.core.run.effects.people import (
    action_refused,
    control_taken,
    item_ticked,
    record_corrected,
    region_drawn,
    run_released,
)
from service.core.run.effects.place import impossible
from service.core.run.effects.runs import (
    files_kept,
    run_aborted,
    run_completed,
    run_started,
    session_started,
)
from service.core.run.effects.steps import (
    gates_evaluated,
    step_failed,
    step_measured,
    step_note,
    step_passed,
    step_retried,
    step_started,
)
from service.core.run.effects.views import capture_asked, view_added, viewpoint_failed
from service.core.run.lifecycle import lifecycle
from service.core.run.operator_transitions import apply_action
from service.core.run.state import RunState, StepState


def initial_state(protocol: Protocol) -> RunState:
    """The state before any event."""
    machine = lifecycle(protocol.step_ids)
    steps = {step: StepState(step) for step in protocol.step_ids}
    first = protocol.step_ids[0]
    steps[first] = replace(steps[first], phase="ready")
    return RunState(machine_state=machine.initial, current=first, steps=steps)


def fold(protocol: Protocol, events: Iterable[Event]) -> RunState:
    """The state of a run after all these events, which begin with the first.

    Raises IntegrityError for a system event that is impossible in its place (tampering, or a bug). An operator's
    action that was not allowed raises nothing: it is listed as refused and has no effect.
    """
    state = initial_state(protocol)
    for event in events:
        state = advance(protocol, state, event)
    return state


def advance(protocol: Protocol, state: RunState, event: Event) -> RunState:
    """The state after one more event. Raises IntegrityError as `fold` does, which applies this to every event."""
    if event.seq != state.seq + 1:
        raise impossible(event, f"follows event {state.seq}: events are missing or repeated")
    if (event.seq == 1) != isinstance(event.payload, RunStarted):
        raise impossible(event, "a run begins with run_started, once")
    if state.started and event.run_id != state.run_id:
        raise impossible(event, f"belongs to another run than {state.run_id}")
    handler = _HANDLERS.get(type(event.payload))
    if handler is None:
        raise impossible(event, "it belongs to the site, not to a run")
    return replace(handler(protocol, state, event, event.payload), seq=event.seq, at_utc=event.at_utc)


def _no_effect(protocol: Protocol, state: RunState, event: Event, p: object) -> RunState:
    return state


_HANDLERS: Mapping[type[Any], Callable[[Protocol, RunState, Event, Any], RunState]] = {
    RunStarted: run_started,
    SessionStarted: session_started,
    DeviceOpened: device_opened,
    DeviceTrouble: device_trouble,
    LeaveLapsed: leave_lapsed,
    StepStarted: step_started,
    FilesKept: files_kept,
    StepNote: step_note,
    ViewpointCaptured: view_added,
    ViewImported: view_added,
    ViewHeld: view_added,
    CaptureAsked: capture_asked,
    RegionDrawn: region_drawn,
    ViewpointFailed: viewpoint_failed,
    StepMeasured: step_measured,
    StepFailed: step_failed,
    StepRetried: step_retried,
    GatesEvaluated: gates_evaluated,
    StepPassed: step_passed,
    JobEnqueued: job_enqueued,
    JobFinished: job_ended,
    JobFailed: job_ended,
    RunCompleted: run_completed,
    RunAborted: run_aborted,
    ActionRefused: action_refused,
    ItemTicked: item_ticked,
    RobotSeen: robot_seen,
    NoteTaken: _no_effect,
    ControlTaken: control_taken,
    RecordCorrected: record_corrected,
    RunReleased: run_released,
    EvidenceExported: _no_effect,
    OperatorAction: apply_action,
}
# What neither moves the lifecycle nor is a deviation: a run of 100 000 events consists mostly of these. Whoever wants
# the outcome alone folds all others; an event kind that is added above is among them unless it is named here.
_DETAILS: frozenset[type[Any]] = frozenset(
    {
        SessionStarted,
        DeviceOpened,
        DeviceTrouble,
        LeaveLapsed,
        RobotSeen,
        FilesKept,
        StepNote,
        CaptureAsked,
        RegionDrawn,
        JobEnqueued,
        JobFinished,
        JobFailed,
        ItemTicked,
        NoteTaken,
        RecordCorrected,
        EvidenceExported,
    }
)


def kind_of(payload: type[Any]) -> str:
    """The name of an event kind in the record."""
    return str(payload.model_fields["kind"].default)


RUN_EVENTS: Mapping[str, type[Any]] = {kind_of(payload): payload for payload in _HANDLERS}  # every event of a run
DECISIVE_EVENTS: tuple[str, ...] = tuple(kind_of(payload) for payload in _HANDLERS if payload not in _DETAILS)
