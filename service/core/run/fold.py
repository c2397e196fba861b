"""Events → RunState, as a pure reduction: the same events always give the same state, also after a restart."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

from service.core.errors import IllegalTransitionError, IntegrityError
from service.core.gates.release import refuse_release
from service.core.gates.verdict import evaluate_gates
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
    OperatorAction,
    RecordCorrected,
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
    View,
    ViewHeld,
    ViewImported,
    ViewpointCaptured,
    ViewpointFailed,
)
from service.core.run.actions import needs_leave, unmet_requirements
from service.core.run.lifecycle import lifecycle
from service.core.run.operator_transitions import apply_action
from service.core.run.persistent_map import put
from service.core.run.state import (
    Correction,
    Failure,
    JobState,
    Note,
    RunState,
    StepState,
    Trouble,
)
from service.core.run.state_transitions import UNMEASURED, change, deviate, go, pass_on, seconds_between, supersede

_VIEWS_TIMED = 30  # number of latest views whose median gap estimates the time per view


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
        raise _impossible(event, f"follows event {state.seq}: events are missing or repeated")
    if (event.seq == 1) != isinstance(event.payload, RunStarted):
        raise _impossible(event, "a run begins with run_started, once")
    if state.started and event.run_id != state.run_id:
        raise _impossible(event, f"belongs to another run than {state.run_id}")
    handler = _HANDLERS.get(type(event.payload))
    if handler is None:
        raise _impossible(event, "it belongs to the site, not to a run")
    return replace(handler(protocol, state, event, event.payload), seq=event.seq)


def _impossible(event: Event, why: str) -> IntegrityError:
    return IntegrityError(
        f"{event.payload.kind} cannot have happened here: {why}",
        where=f"run {event.run_id} event {event.seq}",
        remedy="Run `orthocapture audit verify` on this run; do not continue it",
    )


# --- moving through the lifecycle ------------------------------------------------------------------------


def _system(protocol: Protocol, state: RunState, event: Event, trigger: str, **changes: Any) -> RunState:
    try:
        return go(protocol, state, trigger, **changes)
    except IllegalTransitionError as error:
        raise _impossible(event, str(error)) from error


def _void(state: RunState, event: Event) -> RunState:
    return replace(state, overtaken=(*state.overtaken, event.seq))


def _is_void(state: RunState, event: Event, step: str, attempt: int, *, when_completed: bool = False) -> bool:
    """Whether an operator's redo, skip or abort was recorded before the outcome of the work.

    The web and the command line append actions while the runner works, so such events are legitimate; they stay in
    the evidence without effect. With `when_completed`, the work may still be recorded after the run was completed.
    Raises IntegrityError for work that was never due.
    """
    if step not in state.steps:
        raise _impossible(event, f"the protocol has no step {step!r}")
    there = state.steps[step]
    ended = state.status == "aborted" if when_completed else state.terminal
    if attempt < there.attempt or ended or (there.skipped and attempt == there.attempt):
        return True
    if attempt > there.attempt:
        raise _impossible(event, f"attempt {attempt} of {step} has not begun; it is at {there.attempt}")
    return False


def _is_void_now(state: RunState, event: Event, step: str, attempt: int) -> bool:
    """`_is_void` for events that only the current step can produce. Raises IntegrityError for another step."""
    if _is_void(state, event, step, attempt):
        return True
    if step != state.current:
        raise _impossible(event, f"the run is at {state.current}")
    return False


def _worked_s(state: RunState, event: Event) -> float | None:
    began = state.step.work_began_utc
    return seconds_between(began, event.at_utc) if began else None


def _with_view(state: RunState, event: Event, step: str) -> RunState:
    """Record the time since the step's previous view, for the latest views only."""
    there, at_utc = state.last_view
    gaps = state.view_gaps_s
    if there == step:
        gaps = (*gaps, seconds_between(at_utc, event.at_utc))[-_VIEWS_TIMED:]
    return replace(state, view_gaps_s=gaps, last_view=(step, event.at_utc))


def _require_running(state: RunState, event: Event) -> None:
    if state.phase != "running":
        raise _impossible(event, f"{state.current} is {state.phase}, not running")


# --- run and devices ---------------------------------------------------------------------------------------


def _run_started(protocol: Protocol, state: RunState, event: Event, p: RunStarted) -> RunState:
    if (p.protocol_id, p.protocol_version) != (protocol.id, protocol.version):
        raise _impossible(event, f"the run is of protocol {p.protocol_id} {p.protocol_version}, not of the given one")
    return replace(
        state,
        run_id=event.run_id,
        operator=p.operator,
        simulated=p.simulated,
        origin=p.origin,
        auto_confirm=p.auto_confirm,
        people=frozenset({p.operator}),
    )


def _session_started(protocol: Protocol, state: RunState, event: Event, p: SessionStarted) -> RunState:
    state = replace(state, sessions=state.sessions + 1, restarted=p.resumed, leave=None if p.resumed else state.leave)
    # Whoever lets the robot move again must check again: the ticks were made before the program ended.
    return change(state, state.current, ticked=()) if needs_leave(protocol, state) else state


def _device_trouble(protocol: Protocol, state: RunState, event: Event, p: DeviceTrouble) -> RunState:
    return replace(state, troubles=(*state.troubles, Trouble(event.seq, p.device, p.error, p.message)))


def _files_kept(protocol: Protocol, state: RunState, event: Event, p: FilesKept) -> RunState:
    return _void(state, event) if _is_void(state, event, p.step, p.attempt) else state


def _run_completed(protocol: Protocol, state: RunState, event: Event, p: RunCompleted) -> RunState:
    done = state.current == protocol.step_ids[-1] and state.phase == "passed"
    if state.terminal or not done:
        redone_just_before = state.last_redo_seq == state.seq
        if state.status == "aborted" or redone_just_before:
            return _void(state, event)
        raise _impossible(event, f"the run is {state.status} at {state.current}, {state.phase}")
    completed = _system(protocol, state, event, "advance")
    return replace(completed, completed_sha256=event.sha256, ended_utc=event.at_utc)


def _run_aborted(protocol: Protocol, state: RunState, event: Event, p: RunAborted) -> RunState:
    if state.status == "aborted":  # the runner's own record of an operator's abort
        return replace(state, stop_reason=state.stop_reason or p.reason)
    return replace(_system(protocol, state, event, "abort"), stop_reason=p.reason)


# --- the work of a step --------------------------------------------------------------------------------------


def _step_started(protocol: Protocol, state: RunState, event: Event, p: StepStarted) -> RunState:
    if _is_void_now(state, event, p.step, p.attempt):
        return _void(state, event)
    step, now = protocol.step(p.step), state.step
    if step.confirm and not now.confirmed:
        raise _impossible(event, "the operator has not confirmed")
    if unmet_requirements(step, state) or (step.irreversible and not now.signed):
        raise _impossible(event, "what it requires has not passed, or nobody has signed")
    state = replace(state, last_view=("", ""))
    began = {"started_utc": event.at_utc, "work_began_utc": event.at_utc}
    return _system(protocol, state, event, "begin", failures=0, **began)


def _step_note(protocol: Protocol, state: RunState, event: Event, p: StepNote) -> RunState:
    if _is_void(state, event, p.step, p.attempt):
        return _void(state, event)
    note = Note(event.seq, event.at_utc, p.note, p.data, p.attempt)
    return change(state, p.step, notes=(*state.steps[p.step].notes, note))


def _capture_asked(protocol: Protocol, state: RunState, event: Event, p: CaptureAsked) -> RunState:
    """Note what was asked of a manual capture; a request that comes too late has no effect."""
    if state.terminal or (p.step, p.attempt, "running") != (state.current, state.step.attempt, state.phase):
        return _void(state, event)
    return change(state, p.step, asked=(*state.step.asked, p.what))


def _view_added(protocol: Protocol, state: RunState, event: Event, p: View) -> RunState:
    if _is_void_now(state, event, p.step, p.attempt):
        return _void(_among_the_superseded(state, event, p), event)
    _require_running(state, event)
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
    )


def _among_the_superseded(state: RunState, event: Event, p: View) -> RunState:
    """Add an image that arrived after its attempt was replaced to the superseded images of that attempt."""
    listed = [
        replace(past, captured=put(past.captured, p.viewpoint, event.seq))
        if (past.step, past.attempt, past.viewpoint) == (p.step, p.attempt, None)
        else past
        for past in state.superseded
    ]
    return replace(state, superseded=tuple(listed))


def _viewpoint_failed(protocol: Protocol, state: RunState, event: Event, p: ViewpointFailed) -> RunState:
    if _is_void_now(state, event, p.step, p.attempt):
        return _void(state, event)
    _require_running(state, event)
    now = state.step
    counts = put(now.viewpoint_failures, p.viewpoint, now.viewpoint_failures.get(p.viewpoint, 0) + 1)
    given_up = now.skipped_viewpoints
    if p.skipped and p.viewpoint not in given_up:
        given_up = (*given_up, p.viewpoint)
        state = deviate(state, event, "viewpoint_skipped", p.step, f"{p.viewpoint} given up: {p.message}")
    return change(state, p.step, viewpoint_failures=counts, skipped_viewpoints=given_up)


def _step_measured(protocol: Protocol, state: RunState, event: Event, p: StepMeasured) -> RunState:
    if _is_void_now(state, event, p.step, p.attempt):
        return _void(state, event)
    return _system(
        protocol,
        state,
        event,
        "measured",
        measures=p.measures,
        artefacts=p.artefacts,
        result=p.result,
        uncertainties=p.uncertainties,
        failures=0,
        worked_s=_worked_s(state, event),
    )


def _step_failed(protocol: Protocol, state: RunState, event: Event, p: StepFailed) -> RunState:
    if _is_void_now(state, event, p.step, p.attempt):
        return _void(state, event)
    failure = Failure(event.seq, p.error, p.message, p.recovery)
    changes = {"failure": failure, "failures": state.step.failures + 1, "worked_s": _worked_s(state, event)}
    return _system(protocol, state, event, "failed", **changes)


def _step_retried(protocol: Protocol, state: RunState, event: Event, p: StepRetried) -> RunState:
    if _is_void_now(state, event, p.step, p.attempt - 1):  # a retry names the attempt that it begins
        return _void(state, event)
    now = state.step
    if not (now.retry_granted or (now.failure is not None and now.failure.recovery == "retry")):
        raise _impossible(event, "neither the policy nor the operator allowed a retry")
    state = replace(state, last_view=("", ""))
    changes: dict[str, Any] = {**UNMEASURED, "attempt": p.attempt, "retry_granted": False}
    changes["work_began_utc"] = event.at_utc
    if protocol.step(p.step).irreversible:  # its signature released it to begin and remains valid
        changes |= {"signed": now.signed, "signed_by": now.signed_by}
    if now.retry_granted:  # viewpoints that were given up are tried again
        changes |= {"failures": 0, "viewpoint_failures": {}, "skipped_viewpoints": ()}
    return _system(protocol, state, event, "retry", **changes)


def _gates_evaluated(protocol: Protocol, state: RunState, event: Event, p: GatesEvaluated) -> RunState:
    if _is_void_now(state, event, p.step, p.attempt):
        return _void(state, event)
    now = state.step
    if p != evaluate_gates(protocol.step(p.step), p.attempt, now.measures, state.skipped, now.uncertainties):
        raise _impossible(event, "the verdicts do not follow from the measures and the protocol's limits")
    trigger = "gates_passed" if p.passed else "gates_failed"
    changes = {"verdicts": p.verdicts, "gates_passed": p.passed, "gates_sha256": event.sha256}
    return _system(protocol, state, event, trigger, **changes)


def _step_passed(protocol: Protocol, state: RunState, event: Event, p: StepPassed) -> RunState:
    if _is_void_now(state, event, p.step, p.attempt):
        return _void(state, event)
    if protocol.step(p.step).sign and not state.step.signed:
        raise _impossible(event, "nobody has signed")
    changes = {"passed_sha256": event.sha256, "passed_seq": event.seq, "ended_utc": event.at_utc}
    return pass_on(protocol, _system(protocol, state, event, "accept", **changes))


# --- jobs -----------------------------------------------------------------------------------------------------


def _job_enqueued(protocol: Protocol, state: RunState, event: Event, p: JobEnqueued) -> RunState:
    # A result that arrives after the run's end may still lead to further jobs.
    if _is_void(state, event, p.step, p.attempt, when_completed=True):
        return _void(state, event)
    jobs = state.steps[p.step].jobs
    if p.job in jobs:
        raise _impossible(event, f"job {p.job} is enqueued already")
    job = JobState(
        p.job,
        p.job_kind,
        p.attempt,
        event.seq,
        p.idempotency_key,
        p.arguments,
        priority=p.priority,
        enqueued_utc=event.at_utc,
    )
    return change(state, p.step, jobs=put(jobs, p.job, job))


def _job_ended(protocol: Protocol, state: RunState, event: Event, p: JobFinished | JobFailed) -> RunState:
    job = state.steps[p.step].jobs.get(p.job) if p.step in state.steps else None
    if job is None:
        if _is_void(state, event, p.step, p.attempt):
            return _void(state, event)
        raise _impossible(event, f"job {p.job} was never enqueued")
    if job.status == "finished":  # a second worker answered after a lost lease: the first answer counts
        return _void(state, event)
    if isinstance(p, JobFinished):
        done = {"measures": p.measures, "artefacts": p.artefacts, "result": p.result}
        job = replace(job, status="finished", duration_s=p.duration_s, late_s=p.late_s, **done)
    else:
        job = replace(job, status="failed", error=p.error, message=p.message)
    job = replace(job, ended_seq=event.seq, ended_utc=event.at_utc)
    return change(state, p.step, jobs=put(state.steps[p.step].jobs, p.job, job))


# --- operators ------------------------------------------------------------------------------------------------


def _action_refused(protocol: Protocol, state: RunState, event: Event, p: ActionRefused) -> RunState:
    return deviate(state, event, "refused", p.step, f"{p.action} refused: {p.why}")


def _item_ticked(protocol: Protocol, state: RunState, event: Event, p: ItemTicked) -> RunState:
    """Tick or untick an item; no effect if it comes too late or the protocol has no such item."""
    asked = state.phase in ("ready", "recovering") or needs_leave(protocol, state)
    open_now = asked and (p.step, p.attempt) == (state.current, state.step.attempt)
    if state.terminal or not open_now:
        return _void(state, event)
    items = [item for item in protocol.step(p.step).checklist if item in state.step.ticked and item != p.item]
    if p.ticked and p.item in protocol.step(p.step).checklist:
        items.append(p.item)
    return change(state, p.step, ticked=tuple(items))


def _control_taken(protocol: Protocol, state: RunState, event: Event, p: ControlTaken) -> RunState:
    controller = event.actor if p.screen else ""
    return replace(state, controller=controller, people=state.people | {event.actor})


def _record_corrected(protocol: Protocol, state: RunState, event: Event, p: RecordCorrected) -> RunState:
    correction = Correction(event.seq, p.of_seq, p.field, p.old, p.new, p.reason, event.actor)
    return replace(state, corrections=(*state.corrections, correction))


def _run_released(protocol: Protocol, state: RunState, event: Event, p: RunReleased) -> RunState:
    refusal = refuse_release(state, event.actor, p.signed_sha256)
    if refusal is not None:
        return deviate(state, event, "refused", None, f"release had no effect: {refusal}")
    return replace(state, released_by=event.actor)


def _no_effect(protocol: Protocol, state: RunState, event: Event, p: object) -> RunState:
    return state


_HANDLERS: Mapping[type[Any], Callable[[Protocol, RunState, Event, Any], RunState]] = {
    RunStarted: _run_started,
    SessionStarted: _session_started,
    DeviceOpened: _no_effect,
    DeviceTrouble: _device_trouble,
    StepStarted: _step_started,
    FilesKept: _files_kept,
    StepNote: _step_note,
    ViewpointCaptured: _view_added,
    ViewImported: _view_added,
    ViewHeld: _view_added,
    CaptureAsked: _capture_asked,
    ViewpointFailed: _viewpoint_failed,
    StepMeasured: _step_measured,
    StepFailed: _step_failed,
    StepRetried: _step_retried,
    GatesEvaluated: _gates_evaluated,
    StepPassed: _step_passed,
    JobEnqueued: _job_enqueued,
    JobFinished: _job_ended,
    JobFailed: _job_ended,
    RunCompleted: _run_completed,
    RunAborted: _run_aborted,
    ActionRefused: _action_refused,
    ItemTicked: _item_ticked,
    NoteTaken: _no_effect,
    ControlTaken: _control_taken,
    RecordCorrected: _record_corrected,
    RunReleased: _run_released,
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
        FilesKept,
        StepNote,
        CaptureAsked,
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
