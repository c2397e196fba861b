"""RunState → Decision, the next thing to do as a value. The runner executes it and appends the outcome."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from service.core.errors import IntegrityError
from service.core.gates import describe, describe_accepted, describe_judged, evaluate_gates
from service.core.protocol import Protocol, Step
from service.core.records.run_events import OperatorVerb, Uncertainty
from service.core.recovery import WayOn, ways_on
from service.core.run.actions import (
    allowed_actions,
    needs_leave,
    needs_signature_now,
    record_to_sign,
    redoable_steps,
    unmet_requirements,
)
from service.core.run.fold import advance, fold, initial_state
from service.core.run.state import Deviation, JobState, Lapse, Note, RunState, StepState, Superseded, lost_arms
from service.core.words import time_utc

__all__ = [
    "Accept",
    "AskOperator",
    "Decision",
    "Deviation",
    "EvaluateGates",
    "FinishRun",
    "Halt",
    "JobState",
    "Note",
    "Retry",
    "RunState",
    "RunStep",
    "StepState",
    "Superseded",
    "advance",
    "allowed_actions",
    "decide",
    "evaluate_gates",
    "fold",
    "initial_state",
    "record_to_sign",
    "redoable_steps",
]


@dataclass(frozen=True, slots=True)
class AskOperator:
    """Wait for a person; `options` are the verbs that are allowed now."""

    step: str
    for_: Literal["confirm", "sign", "recovery"]
    text: str
    checklist: tuple[str, ...]  # to be ticked with the confirmation
    options: tuple[OperatorVerb, ...]
    sign_sha256: str = ""  # the hash that a signature binds (OperatorAction.signed_sha256)
    ways: tuple[WayOn, ...] = ()  # the choices when the step is stopped, the recommended one first


@dataclass(frozen=True, slots=True)
class RunStep:
    """Do the work of a step or continue it. With `begin`, append StepStarted first."""

    step: str
    attempt: int
    begin: bool


@dataclass(frozen=True, slots=True)
class EvaluateGates:
    """Append the verdicts of evaluate_gates(step, attempt, measures, skipped steps, uncertainties)."""

    step: str
    attempt: int
    measures: Mapping[str, float]
    uncertainties: Mapping[str, Uncertainty] = field(default_factory=dict[str, Uncertainty])


@dataclass(frozen=True, slots=True)
class Accept:
    """Let the step pass: append StepPassed."""

    step: str
    attempt: int


@dataclass(frozen=True, slots=True)
class Retry:
    """Wait, then append StepRetried with this attempt number; what was captured stays."""

    step: str
    attempt: int
    why: str
    wait_s: float


@dataclass(frozen=True, slots=True)
class FinishRun:
    """The run is complete: append RunCompleted."""

    deviations: int


@dataclass(frozen=True, slots=True)
class Halt:
    """No motion and no work, until an operator resumes a paused run, or for good."""

    status: Literal["paused", "completed", "aborted"]


Decision = AskOperator | RunStep | EvaluateGates | Accept | Retry | FinishRun | Halt


def decide(protocol: Protocol, state: RunState) -> Decision:  # noqa: PLR0911 - one return per phase
    """Return what the runner does next. Raises IntegrityError if nothing is recorded of the run."""
    if not state.started:
        raise IntegrityError("nothing is recorded of this run", remedy="Append run_started first")
    if state.status != "active":
        return Halt(state.status)
    now = state.step
    match state.phase:
        case "ready":
            return _decide_ready(protocol, state)
        case "running" if needs_leave(protocol, state):
            return _ask(protocol, state, "confirm", _what_goes_on(protocol.step(now.step), state))
        case "running":
            return RunStep(now.step, now.attempt, begin=False)
        case "checking":
            return EvaluateGates(now.step, now.attempt, now.measures, now.uncertainties)
        case "awaiting_operator":
            if needs_signature_now(protocol, state):
                return _ask(protocol, state, "sign", _what_is_signed(now))
            return Accept(now.step, now.attempt)
        case "recovering":
            return _decide_recovering(protocol, state)
        case "passed":
            return FinishRun(len(state.deviations))


def _what_goes_on(step: Step, state: RunState) -> str:
    taken = len(state.step.captured)
    images = {0: "it had taken no image yet", 1: "its image is kept"}.get(taken, f"its {taken} images are kept")
    if state.lapse is not None and not state.restarted:
        happened = f"{lapsed_words(state.lapse)} ({step.title}; {images})"
    else:
        happened = f"The program that drove the robot ended during this step ({step.title}); {images}"
    check = "Check that nothing has changed and nobody is within reach; the robot moves as soon as you confirm"
    return f"{happened}. {check}"


def lapsed_words(lapse: Lapse) -> str:
    """Say why a confirmation no longer holds."""
    waited = f", in which the run waited for this: {lapse.why}" if lapse.why else ""
    return (
        f"The confirmation of {lapse.by} no longer lets the robot move: for {lapse.idle_s:.0f} s there was no "
        f"visible progress{waited}. It holds for {lapse.limit_s:.0f} s"
    )


def _what_is_signed(now: StepState) -> str:
    figures = "; ".join(describe(verdict) for verdict in now.verdicts) or "this step has no gates"
    head = "Passed its gates" if now.accepted is None else f"{describe_accepted(now.accepted)}. All its figures"
    return f"{head}: {figures}. Check the figures and sign"


def _decide_ready(protocol: Protocol, state: RunState) -> Decision:
    step, now = protocol.step(state.current), state.step
    unmet = unmet_requirements(step, state)
    if unmet:
        return _ask(protocol, state, "recovery", f"Required before it and not passed: {', '.join(unmet)}")
    if needs_signature_now(protocol, state):
        passed = ", ".join(step.requires)
        text = f"{step.title} cannot be undone. Its captures have passed: {passed}. Sign to let it begin"
        return _ask(protocol, state, "sign", text)
    if step.begins_confirmed and (not now.confirmed or needs_leave(protocol, state)):
        return _ask(protocol, state, "confirm", step.instructions or step.title)
    return RunStep(now.step, now.attempt, begin=True)


def _decide_recovering(protocol: Protocol, state: RunState) -> Decision:
    step, now = protocol.step(state.current), state.step
    anew = needs_leave(protocol, state)
    if now.retry_granted and not anew:
        return Retry(now.step, now.attempt + 1, "the operator asked for it", 0.0)
    if now.failure is None:
        outside = any(not verdict.passed and not verdict.undecided for verdict in now.verdicts)
        say = describe_judged if outside else describe  # else the heading says that all of them are undecided
        failed = "; ".join(say(verdict) for verdict in now.verdicts if not verdict.passed)
        found = "Outside its limits" if outside else "Not decided yet"
        # The step may suggest a remedy, such as further viewpoints that would bring the figures within limits.
        advice = now.mend.advice if now.mend is not None else ""
        return _ask(protocol, state, "recovery", f"{found}: {failed}" + (f". {advice}" if advice else ""))
    why = f"{now.failure.error}: {now.failure.message}"
    if anew and now.failure.recovery == "retry":
        lapsed = f". {lapsed_words(state.lapse)}" if state.lapse is not None and not state.restarted else ""
        return _ask(protocol, state, "recovery", f"{why}{lapsed}. The robot moves again as soon as you confirm")
    match now.failure.recovery:
        case "retry":
            return Retry(now.step, now.attempt + 1, why, step.recovery.wait_s)
        case "abort":  # only a person ends a run
            return _ask(protocol, state, "recovery", f"{why}. The protocol recommends to end the run here")
        case "ask":
            return _ask(protocol, state, "recovery", why)


def _ask(protocol: Protocol, state: RunState, for_: Literal["confirm", "sign", "recovery"], text: str) -> AskOperator:
    items = protocol.step(state.current).checklist
    unticked = state.phase == "recovering" and len(state.step.ticked) < len(items)
    checklist = items if for_ == "confirm" or unticked else ()
    options = allowed_actions(protocol, state)
    missing = lost_arms(state) if "confirm" in options and protocol.step(state.current).moves_robot else {}
    for name, loss in missing.items():
        text += (
            f". Look at {name} first: the connection to it was lost at {time_utc(loss.since_utc)}, {loss.how}; it "
            "counts as moving until somebody has looked, which you say with your confirmation"
        )
    signed = record_to_sign(protocol, state)
    return AskOperator(state.current, for_, text, checklist, options, signed, ways_on(protocol, state))
