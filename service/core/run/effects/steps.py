"""What the events of a step's work do to the state."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from service.core.gates.verdict import evaluate_gates
from service.core.protocol.models import Protocol
from service.core.records.events import (
    Event,
    GatesEvaluated,
    StepFailed,
    StepMeasured,
    StepNote,
    StepPassed,
    StepRetried,
    StepStarted,
)
from service.core.run.actions import unmet_requirements
from service.core.run.effects.place import impossible, is_void, is_void_now, triggered, without_effect
from service.core.run.state import FailedTries, Failure, Note, RunState
from service.core.run.state_transitions import NOT_WAITING, UNMEASURED, change, pass_on


def worked_s(state: RunState, event: Event) -> float | None:
    """Seconds that the work of the current step has taken; None if it did not begin."""
    return state.step.work_s(event.at_utc) if state.step.work_began_utc else None


def step_started(protocol: Protocol, state: RunState, event: Event, p: StepStarted) -> RunState:
    """The step's work begins, if a person has confirmed it and what it requires has passed."""
    if is_void_now(state, event, p.step, p.attempt):
        return without_effect(state, event)
    step, now = protocol.step(p.step), state.step
    if step.confirm and not now.confirmed:
        raise impossible(event, "the operator has not confirmed")
    if unmet_requirements(step, state) or (step.irreversible and not now.signed):
        raise impossible(event, "what it requires has not passed, or nobody has signed")
    state = replace(state, last_view=("", ""))
    began = {"started_utc": event.at_utc, "work_began_utc": event.at_utc, **NOT_WAITING}
    return triggered(protocol, state, event, "begin", failures=0, **began)


def step_note(protocol: Protocol, state: RunState, event: Event, p: StepNote) -> RunState:
    """Keep what a step noted."""
    if is_void(state, event, p.step, p.attempt):
        return without_effect(state, event)
    note = Note(event.seq, event.at_utc, p.note, p.data, p.attempt)
    return change(state, p.step, notes=(*state.steps[p.step].notes, note))


def step_measured(protocol: Protocol, state: RunState, event: Event, p: StepMeasured) -> RunState:
    """Keep the measures and the result of a step; its gates are judged next."""
    if is_void_now(state, event, p.step, p.attempt):
        return without_effect(state, event)
    return triggered(
        protocol,
        state,
        event,
        "measured",
        measures=p.measures,
        artefacts=p.artefacts,
        result=p.result,
        uncertainties=p.uncertainties,
        computed_by=p.computed_by,
        failures=0,
        tries=None,
        worked_s=worked_s(state, event),
    )


def step_failed(protocol: Protocol, state: RunState, event: Event, p: StepFailed) -> RunState:
    """Keep why a step failed."""
    if is_void_now(state, event, p.step, p.attempt):
        return without_effect(state, event)
    failure = Failure(event.seq, p.error, p.message, p.recovery, event.at_utc)
    failures = state.step.failures + 1
    tries = state.step.tries
    if tries is None or tries.message != p.message:  # else it is the failure of a viewpoint, told before
        tries = FailedTries("", failures, p.message, event.at_utc)
    changes = {"failure": failure, "failures": failures, "tries": tries, "worked_s": worked_s(state, event)}
    return triggered(protocol, state, event, "failed", **changes)


def step_retried(protocol: Protocol, state: RunState, event: Event, p: StepRetried) -> RunState:
    """The next attempt of a step begins."""
    if is_void_now(state, event, p.step, p.attempt - 1):  # a retry names the attempt that it begins
        return without_effect(state, event)
    now = state.step
    if not (now.retry_granted or (now.failure is not None and now.failure.recovery == "retry")):
        raise impossible(event, "neither the policy nor the operator allowed a retry")
    state = replace(state, last_view=("", ""))
    changes: dict[str, Any] = {**UNMEASURED, "attempt": p.attempt, "retry_granted": False}
    changes |= {"work_began_utc": event.at_utc, **NOT_WAITING}
    if protocol.step(p.step).irreversible:  # its signature let it begin and remains valid
        changes |= {"signed": now.signed, "signed_by": now.signed_by}
    if now.retry_granted:  # viewpoints that were given up are tried again
        changes |= {"failures": 0, "viewpoint_failures": {}, "skipped_viewpoints": ()}
    return triggered(protocol, state, event, "retry", **changes)


def gates_evaluated(protocol: Protocol, state: RunState, event: Event, p: GatesEvaluated) -> RunState:
    """Keep the verdicts, which must follow from the measures and the limits."""
    if is_void_now(state, event, p.step, p.attempt):
        return without_effect(state, event)
    now = state.step
    if p != evaluate_gates(protocol.step(p.step), p.attempt, now.measures, state.skipped, now.uncertainties):
        raise impossible(event, "the verdicts do not follow from the measures and the protocol's limits")
    trigger = "gates_passed" if p.passed else "gates_failed"
    changes = {"verdicts": p.verdicts, "gates_passed": p.passed, "gates_sha256": event.sha256}
    return triggered(protocol, state, event, trigger, **changes)


def step_passed(protocol: Protocol, state: RunState, event: Event, p: StepPassed) -> RunState:
    """The run goes on to the next step."""
    if is_void_now(state, event, p.step, p.attempt):
        return without_effect(state, event)
    if protocol.step(p.step).sign and not state.step.signed:
        raise impossible(event, "nobody has signed")
    changes = {"passed_sha256": event.sha256, "passed_seq": event.seq, "ended_utc": event.at_utc}
    return pass_on(protocol, triggered(protocol, state, event, "accept", **changes))
