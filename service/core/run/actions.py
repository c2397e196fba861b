"""Which operator actions are allowed now, or why not: one set of rules for web, command line and fold."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from service.core.errors import IllegalTransitionError
from service.core.gates import acceptance_refusal, acceptor_refusal
from service.core.protocol import Protocol, Step
from service.core.records.run_events import OperatorAction, OperatorVerb
from service.core.run.lifecycle import lifecycle, redo
from service.core.run.state import RunState

Refusal = IllegalTransitionError
VERBS: tuple[OperatorVerb, ...] = ("confirm", "sign", "redo", "skip", "accept", "pause", "resume", "abort")


def refuse(protocol: Protocol, state: RunState, action: OperatorAction, actor: str) -> Refusal | None:
    """Return the reason to refuse an action that a person asks for now, or None."""
    refusal = recorded_refusal(protocol, state, action, actor)
    if refusal is None and action.action == "abort":
        return _reason_refusal(action, state.current)
    return refusal


def recorded_refusal(protocol: Protocol, state: RunState, action: OperatorAction, actor: str) -> Refusal | None:  # noqa: PLR0911 - one return per rule
    """Return the reason why a recorded action had no effect, or None.

    A run could once be ended without a reason: such a record still ends its run.
    """
    if not state.started:
        return Refusal("the run has not started", where=action.action)
    if state.terminal:
        return Refusal(f"the run is {state.status}", where=action.action, remedy="Start a new run")
    if action.automatic and not (state.simulated and state.auto_confirm):
        return Refusal(
            "automatic confirmations are for simulated rigs only",
            where=action.action,
            remedy="A person confirms on the screen, with the pedal or on the command line",
        )
    if action.step is not None and action.step not in state.steps:
        return Refusal(f"there is no step {action.step!r}", where=action.action)
    if action.action in ("confirm", "sign", "skip", "accept"):
        if state.paused:
            return Refusal("the run is paused", where=action.action, remedy="Resume first")
        if action.step is not None and action.step != state.current:
            return Refusal(
                f"step {action.step!r} is not the current one", where=action.action, remedy=f"Now: {state.current}"
            )
    return _RULES[action.action](protocol, state, action, actor)


def capture_refusal(protocol: Protocol, state: RunState, step: str, attempt: int) -> Refusal | None:
    """Return the reason why nobody can ask a manual capture now to release the shutter or to finish, or None."""
    if state.terminal:
        return Refusal(f"the run is {state.status}", where=step, remedy="Start a new run")
    if state.paused:
        return Refusal("the run is paused", where=step, remedy="Resume first")
    now = state.step
    if (step, attempt) != (now.step, now.attempt) or not protocol.step(step).by_hand:
        title = protocol.step(now.step).title
        return Refusal("this step takes no images now", where=step, remedy=f"The run is at: {title}")
    if now.phase != "running":
        return Refusal(
            "this step takes no images now", where=step, remedy=f"It is {now.phase.replace('_', ' ')}: confirm first"
        )
    return None


def needs_leave(protocol: Protocol, state: RunState) -> bool:
    """Return whether a person must confirm again before the robot moves, after a restart of the runner or a lapse."""
    return (state.restarted or state.lapse is not None) and protocol.step(state.current).moves_robot


def redo_moves(protocol: Protocol, state: RunState, step: str) -> bool:
    """Return whether the robot moves to a viewpoint of `step` as soon as it is to be redone, without asking again."""
    under_way = state.current == step and state.phase == "running"
    return under_way and not state.paused and not needs_leave(protocol, state)


def unmet_requirements(step: Step, state: RunState) -> tuple[str, ...]:
    """Return the steps required by `step` that have not passed their gates; a skipped step has not."""
    return tuple(name for name in step.requires if not state.steps[name].passed_its_gates)


def stranded(protocol: Protocol, state: RunState) -> bool:
    """Return whether the current step can never begin: a required step has not passed and cannot be redone.

    It may then be skipped whatever the protocol says; otherwise the run could only be ended.
    """
    unmet = unmet_requirements(protocol.step(state.current), state) if state.phase == "ready" else ()
    return any(redo_refusal(protocol, state, name) is not None for name in unmet)


def redo_refusal(protocol: Protocol, state: RunState, target: str) -> Refusal | None:
    """Return the reason why a step cannot be done again now, or None."""
    return refuse(protocol, state, OperatorAction(action="redo", step=target, reason="asked"), "operator")


def skip_refusal(protocol: Protocol, state: RunState) -> Refusal | None:
    """Return the reason why the current step cannot be skipped now, or None."""
    return refuse(protocol, state, OperatorAction(action="skip", step=state.current, reason="asked"), "operator")


def needs_signature_now(protocol: Protocol, state: RunState) -> bool:
    """Return whether a signature is due now: before an irreversible step begins, or before any other step passes."""
    step = protocol.step(state.current)
    due_phase = "ready" if step.irreversible else "awaiting_operator"
    return step.sign and not state.step.signed and state.phase == due_phase


def record_to_sign(protocol: Protocol, state: RunState) -> str:
    """Return the SHA-256 of the event that a signature must bind now, or "" when none is due.

    That is the step's gates_evaluated event. For an irreversible step it is the latest step_passed
    among the steps it requires; the chain binds the earlier ones.
    """
    if not needs_signature_now(protocol, state):
        return ""
    step = protocol.step(state.current)
    if not step.irreversible:
        return state.step.gates_sha256
    if unmet_requirements(step, state):
        return ""
    return max((state.steps[name] for name in step.requires), key=lambda s: s.passed_seq).passed_sha256


def allowed_actions(protocol: Protocol, state: RunState) -> tuple[OperatorVerb, ...]:
    """Return the verbs that would be allowed now, given what they need (ticked items, a reason, a signature)."""
    step = protocol.step(state.current)
    full = {
        "reason": "asked",
        "checklist": step.checklist,
        "meaning": "asked",
        "signed_sha256": record_to_sign(protocol, state),
    }
    actions: dict[OperatorVerb, OperatorAction] = {
        verb: OperatorAction.model_validate({"action": verb, "step": state.current, **full}) for verb in VERBS
    }
    redo_possible = bool(redoable_steps(protocol, state))
    return tuple(
        verb
        for verb, action in actions.items()
        if (
            redo_possible
            if verb == "redo"
            else acceptance_refusal(protocol, state) is None and not state.paused and not state.terminal
            if verb == "accept"
            else refuse(protocol, state, action, "operator") is None
        )
    )


def redoable_steps(protocol: Protocol, state: RunState) -> tuple[str, ...]:
    """Return the steps that an operator could send the run back to now."""
    return tuple(step for step in protocol.step_ids if redo_refusal(protocol, state, step) is None)


# --- one rule per verb -----------------------------------------------------------------------------------


def _confirm(protocol: Protocol, state: RunState, action: OperatorAction, actor: str) -> Refusal | None:  # noqa: PLR0911 - one return per rule
    step, now = protocol.step(state.current), state.step
    anew = needs_leave(protocol, state)
    if state.phase == "recovering":
        if now.retry_granted and not anew:
            return Refusal("already confirmed", where=step.id)
        return None
    if state.phase != "ready" and not (anew and state.phase == "running"):
        return Refusal(f"nothing to confirm while the step is {state.phase}", where=step.id)
    if (now.confirmed and not anew) or not step.begins_confirmed:
        return Refusal("already confirmed" if now.confirmed else "this step starts by itself", where=step.id)
    refusal = _requirements_refusal(step, state)
    if refusal is not None:
        return refusal
    if step.irreversible and not now.signed:
        return Refusal(
            "an irreversible step must be approved by a signature first", where=step.id, remedy="Sign, then confirm"
        )
    unticked = [item for item in step.checklist if item not in action.checklist]
    if unticked:
        return Refusal(
            f"{len(unticked)} of {len(step.checklist)} checklist items are not ticked: {'; '.join(unticked)}",
            where=step.id,
            remedy="Tick every item that is done, then confirm",
        )
    return None


def _sign(protocol: Protocol, state: RunState, action: OperatorAction, actor: str) -> Refusal | None:
    step = protocol.step(state.current)
    if not needs_signature_now(protocol, state):
        return Refusal(f"no signature is due while the step is {state.phase}", where=step.id)
    if step.irreversible:
        refusal = _requirements_refusal(step, state)
        if refusal is not None:
            return refusal
    if action.via == "pedal":
        return Refusal("a pedal cannot sign", where=step.id, remedy="Sign on the screen or the command line")
    if not actor.strip() or not action.meaning.strip():
        return Refusal("a signature needs a name and a meaning", where=step.id, remedy="Say who signs and for what")
    if action.signed_sha256 != record_to_sign(protocol, state):
        return Refusal(
            "the signature is for a record other than the present one of this step",
            where=step.id,
            remedy="Read the figures again and sign them as they are now",
        )
    return None


def _skip(protocol: Protocol, state: RunState, action: OperatorAction, actor: str) -> Refusal | None:
    step = protocol.step(state.current)
    if not (step.skippable or stranded(protocol, state)):
        return Refusal(
            "the protocol does not allow this step to be skipped",
            where=step.id,
            remedy="Redo it, or end the run here",
        )
    if not lifecycle(protocol.step_ids).may(state.machine_state, "skip"):
        return Refusal(
            f"a step cannot be skipped while it is {state.phase}", where=step.id, remedy="Wait for it to end"
        )
    return _reason_refusal(action, step.id)


def _redo(protocol: Protocol, state: RunState, action: OperatorAction, actor: str) -> Refusal | None:  # noqa: PLR0911 - one return per rule
    target = action.step or state.current
    there = state.steps[target]
    if there.phase == "pending":
        return Refusal("this step has not begun", where=target)
    if not lifecycle(protocol.step_ids).may(state.machine_state, redo(target)):
        return Refusal(f"redo is not possible while the run is at {state.current}", where=target)
    if action.viewpoint is not None:
        if target != state.current:
            return Refusal(
                "a single viewpoint can be redone in the current step only",
                where=target,
                remedy="Redo the whole step",
            )
        known = {*there.captured, *there.viewpoint_failures, *there.skipped_viewpoints}
        if action.viewpoint not in known:
            return Refusal(f"viewpoint {action.viewpoint!r} has not been captured", where=target)
    elif target == state.current and there.phase == "ready":
        return Refusal("this step has not begun; there is nothing to redo", where=target)
    for later in protocol.steps[protocol.index(target) + 1 :]:
        if later.irreversible and _has_begun(state, later):
            return Refusal(
                f"{later.id!r} has changed the scene: steps before it cannot be done again",
                where=target,
                remedy=f"Go on from the steps after {later.id}, or start a new run with a new scene",
            )
    return _reason_refusal(action, target)


def _has_begun(state: RunState, step: Step) -> bool:
    """Return whether a step may have changed the scene; one that began counts, a skipped one does not."""
    there = state.steps[step.id]
    return bool(there.started_utc) or any(past.step == step.id and past.began for past in state.superseded)


def _accept(protocol: Protocol, state: RunState, action: OperatorAction, actor: str) -> Refusal | None:
    step = protocol.step(state.current)
    refusal = acceptance_refusal(protocol, state) or acceptor_refusal(protocol, state, action, actor)
    if refusal is not None:
        return refusal
    if action.signed_sha256 != state.step.gates_sha256:
        return Refusal(
            "the acceptance is for figures other than the present ones of this step",
            where=step.id,
            remedy="Read the figures again and decide on them as they are now",
        )
    return _reason_refusal(action, step.id)


def _pause(protocol: Protocol, state: RunState, action: OperatorAction, actor: str) -> Refusal | None:
    return Refusal("the run is paused already", where=state.current) if state.paused else None


def _resume(protocol: Protocol, state: RunState, action: OperatorAction, actor: str) -> Refusal | None:
    return None if state.paused else Refusal("the run is not paused", where=state.current)


def _abort(protocol: Protocol, state: RunState, action: OperatorAction, actor: str) -> Refusal | None:
    return None


_RULES: Mapping[OperatorVerb, Callable[[Protocol, RunState, OperatorAction, str], Refusal | None]] = {
    "confirm": _confirm,
    "sign": _sign,
    "redo": _redo,
    "skip": _skip,
    "accept": _accept,
    "pause": _pause,
    "resume": _resume,
    "abort": _abort,
}


def _requirements_refusal(step: Step, state: RunState) -> Refusal | None:
    unmet = unmet_requirements(step, state)
    if not unmet:
        return None
    return Refusal(
        f"required before it and not passed: {', '.join(unmet)}",
        where=step.id,
        remedy=f"Redo {unmet[0]} and let it pass its gates; a skipped step does not count",
    )


def _reason_refusal(action: OperatorAction, where: str) -> Refusal | None:
    if action.reason.strip():
        return None
    return Refusal(f"{action.action} needs a reason", where=where, remedy="Say why; it goes into the record")
