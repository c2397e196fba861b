"""Events → RunState, as a pure reduction: the same events always give the same state, also after a restart."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from service.core.errors import IntegrityError
from service.core.gates import describe_accepted, failed_gates
from service.core.protocol import Protocol
from service.core.records.entered import NoteTaken
from service.core.records.events import Event
from service.core.records.run_events import (
    ActionRefused,
    CaptureAsked,
    ControlTaken,
    DeviceOpened,
    DeviceTrouble,
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
from service.core.run.actions import recorded_refusal
from service.core.run.effects import (
    action_refused,
    all_seen,
    capture_asked,
    control_taken,
    device_opened,
    device_trouble,
    files_kept,
    gates_evaluated,
    impossible,
    item_ticked,
    job_ended,
    job_enqueued,
    leave_lapsed,
    region_drawn,
    robot_seen,
    run_aborted,
    run_completed,
    run_released,
    run_started,
    session_started,
    step_failed,
    step_measured,
    step_note,
    step_passed,
    step_retried,
    step_started,
    view_added,
    viewpoint_failed,
)
from service.core.run.lifecycle import lifecycle, redo
from service.core.run.state import (
    UNMEASURED,
    AcceptedDeviation,
    DeviationKind,
    Leave,
    RunState,
    StepState,
    change,
    deviate,
    go,
    pass_on,
    supersede,
    wait,
    wait_no_more,
)


def apply_action(protocol: Protocol, state: RunState, event: Event, p: OperatorAction) -> RunState:  # noqa: PLR0911 - one return per verb
    """Return the state after an action; one that is not allowed is listed as refused and has no other effect."""
    refusal = recorded_refusal(protocol, state, p, event.actor)
    if refusal is not None:
        return deviate(state, event, "refused", p.step, f"{p.action} had no effect: {refusal}")
    state = replace(state, people=state.people | {event.actor})
    if p.automatic:
        state = deviate(
            state, event, "automatic", state.current, f"{p.action} given automatically on a simulated rig"
        )
    match p.action:
        case "confirm":
            return _confirm(_let_move(protocol, state, event), event, p)
        case "sign":
            return change(state, state.current, signed=True, signed_by=event.actor)
        case "accept":
            accepted = AcceptedDeviation(
                event.seq, event.actor, p.role, p.identified, p.reason, failed_gates(state.step)
            )
            state = deviate(state, event, "gate_accepted", state.current, describe_accepted(accepted))
            return go(protocol, state, "gates_accepted", accepted=accepted)
        case "skip":
            overridden = bool(state.step.verdicts) and not state.step.gates_passed
            kind: DeviationKind = "gate_overridden" if overridden else "skip"
            state = deviate(state, event, kind, state.current, p.reason)
            return pass_on(protocol, go(protocol, state, "skip", skipped=True, ended_utc=event.at_utc))
        case "abort":
            return replace(go(protocol, state, "abort"), stop_reason=p.reason or f"aborted by {event.actor}")
        case "pause":
            return go(protocol, wait(protocol, state, event), "pause")
        case "resume":
            return go(protocol, _let_move(protocol, state, event), "resume")
        case "redo" if p.viewpoint is not None:
            return replace(_redo_viewpoint(protocol, state, event, p.viewpoint, p.reason), last_redo_seq=event.seq)
        case "redo":
            target = p.step or state.current
            return replace(_redo_step(protocol, state, event, target, p.reason), last_redo_seq=event.seq)


def _let_move(protocol: Protocol, state: RunState, event: Event) -> RunState:
    state = replace(state, restarted=False, lapse=None, leave=Leave(event.seq, event.actor))
    state = wait_no_more(change(state, state.current, tries=None), event)
    return all_seen(state, event) if protocol.step(state.current).moves_robot else state


def _confirm(state: RunState, event: Event, p: OperatorAction) -> RunState:
    ticked = p.checklist or state.step.ticked  # items left open before may be ticked now
    there = change(state, state.current, confirmed_by=event.actor, ticked=ticked)
    match state.phase:
        case "running":  # after a restart: the work goes on
            return there
        case "recovering":
            return change(there, state.current, retry_granted=True)
        case _:
            return change(there, state.current, confirmed=True)


def _redo_step(protocol: Protocol, state: RunState, event: Event, target: str, reason: str) -> RunState:
    """Go back to `target`: it and every later step start afresh."""
    for step in protocol.step_ids[protocol.index(target) :]:
        now = state.steps[step]
        if now.phase == "pending":
            continue
        began = bool(now.started_utc)
        if step == target:
            state = deviate(state, event, "redo", step, reason)
        elif began or now.skipped:
            state = deviate(state, event, "reset_by_redo", step, f"reset because {target} is done again: {reason}")
        if began or now.skipped:
            state = supersede(state, event, step, reason, None, now.captured)
        # Count up even if nothing had started, so that an outcome recorded later is known to be void.
        state = replace(state, steps={**state.steps, step: StepState(step, attempt=now.attempt + 1)})
    return go(protocol, state, redo(target))


def _redo_viewpoint(protocol: Protocol, state: RunState, event: Event, viewpoint: str, reason: str) -> RunState:
    """Forget one viewpoint; a step that had finished its work becomes ready again and keeps the others."""
    now = state.step
    state = deviate(state, event, "redo_viewpoint", state.current, f"{viewpoint}: {reason}")
    if viewpoint in now.captured:
        state = supersede(state, event, state.current, reason, viewpoint, {viewpoint: now.captured[viewpoint]})
    changes: dict[str, Any] = {
        "captured": {name: seq for name, seq in now.captured.items() if name != viewpoint},
        "viewpoint_failures": {name: n for name, n in now.viewpoint_failures.items() if name != viewpoint},
        "skipped_viewpoints": tuple(name for name in now.skipped_viewpoints if name != viewpoint),
    }
    if now.phase in ("running", "ready"):
        return change(state, state.current, **changes)
    changes |= {**UNMEASURED, "attempt": now.attempt + 1, "skipped": False, "retry_granted": False}
    changes |= {"confirmed": False, "ticked": (), "passed_sha256": "", "passed_seq": 0, "ended_utc": ""}
    return go(protocol, change(state, state.current, **changes), redo(state.current))


def initial_state(protocol: Protocol) -> RunState:
    """Return the state before any event."""
    machine = lifecycle(protocol.step_ids)
    steps = {step: StepState(step) for step in protocol.step_ids}
    first = protocol.step_ids[0]
    steps[first] = replace(steps[first], phase="ready")
    return RunState(machine_state=machine.initial, current=first, steps=steps)


def fold(protocol: Protocol, events: Iterable[Event]) -> RunState:
    """Return the state of a run after all these events, which begin with the first.

    Raises IntegrityError for a system event that is impossible in its place (tampering, or a bug). An operator's
    action that was not allowed raises nothing: it is listed as refused and has no effect.
    """
    state = initial_state(protocol)
    for event in events:
        state = advance(protocol, state, event)
    return state


def advance(protocol: Protocol, state: RunState, event: Event) -> RunState:
    """Return the state after one more event.

    Raises IntegrityError as `fold` does, which applies this to every event.
    """
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
    RecordCorrected: _no_effect,  # the original stands; readers see the correction beside it
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
    """Return the name of an event kind in the record."""
    return str(payload.model_fields["kind"].default)


RUN_EVENTS: Mapping[str, type[Any]] = {kind_of(payload): payload for payload in _HANDLERS}  # every event of a run
DECISIVE_EVENTS: tuple[str, ...] = tuple(kind_of(payload) for payload in _HANDLERS if payload not in _DETAILS)


@dataclass(frozen=True, slots=True)
class FoldedRun:
    """The events of one run at one moment and their fold, which belong together."""

    run_id: str
    protocol: Protocol
    events: Sequence[Event]
    state: RunState

    @property
    def root(self) -> RunStarted:
        """The run's first event. Raises IntegrityError if it is not run_started."""
        root = self.events[0].payload if self.events else None
        if not isinstance(root, RunStarted):
            raise IntegrityError("the run's first event is not run_started", where=self.run_id)
        return root
