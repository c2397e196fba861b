"""Accepting a measure outside its limits: who may, who may not, the text for it, and which steps depend on it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from service.core.errors import IllegalTransitionError
from service.core.gates.measure_names import measure_name
from service.core.gates.verdict import describe_judged
from service.core.protocol.models import AcceptedBy, Protocol, Step
from service.core.records.events import GateVerdict, OperatorAction
from service.core.run.state import AcceptedDeviation, RunState, StepState

ROLE_OF: Mapping[AcceptedBy, str] = {"supervisor": "supervisor", "another_supervisor": "supervisor"}


def failed_gates(step: StepState) -> tuple[GateVerdict, ...]:
    """Return the verdicts of a step that did not pass: outside the limits, undecided or not measured."""
    return tuple(verdict for verdict in step.verdicts if not verdict.passed)


def acceptors(protocol: Protocol, state: RunState) -> frozenset[AcceptedBy]:
    """Return who may accept the failed gates of the current step by the protocol; empty when none failed."""
    by: dict[str, AcceptedBy | None] = {g.measure: g.accept_by for g in protocol.step(state.current).gates}
    found: set[AcceptedBy] = set()
    for verdict in failed_gates(state.step):
        asked = by.get(verdict.measure)
        if asked is not None:
            found.add(asked)
    return frozenset(found)


def demanded_role(protocol: Protocol, state: RunState) -> str:
    """Return the role that may accept the figures of the current step; "" when nobody may."""
    roles = sorted({ROLE_OF[by] for by in acceptors(protocol, state)})
    return roles[0] if roles and acceptance_refusal(protocol, state) is None else ""


def acceptance_refusal(protocol: Protocol, state: RunState) -> IllegalTransitionError | None:
    """Return the reason why nobody at all may accept the figures of the current step, or None."""
    step, now = protocol.step(state.current), state.step
    failed = failed_gates(now)
    if state.phase != "recovering" or now.failure is not None or not failed:
        return IllegalTransitionError("no figure of this step needs acceptance", where=step.id)
    if now.retry_granted:
        return IllegalTransitionError("the step is about to be tried again", where=step.id, remedy="Wait for it")
    by = {gate.measure: gate.accept_by for gate in step.gates}
    forbidden = [measure_name(verdict.measure) for verdict in failed if by.get(verdict.measure) is None]
    if forbidden:
        return IllegalTransitionError(
            f"the protocol allows nobody to accept {', '.join(forbidden)} outside the limits",
            where=step.id,
            remedy="Mend it, do the step again, or end the run here",
        )
    unmeasured = [measure_name(verdict.measure) for verdict in failed if verdict.value is None]
    if unmeasured:
        return IllegalTransitionError(
            f"{', '.join(unmeasured)} was not measured: there is nothing to judge",
            where=step.id,
            remedy="Do the step again",
        )
    return None


def acceptor_refusal(
    protocol: Protocol, state: RunState, action: OperatorAction, actor: str
) -> IllegalTransitionError | None:
    """Return the reason why this person may not accept the figures of the current step, or None."""
    if action.automatic or action.via in ("pedal", "auto"):
        return IllegalTransitionError(
            "only a person may accept figures outside their limits, by a signature", where=state.current
        )
    asked = acceptors(protocol, state)
    role = demanded_role(protocol, state)
    if action.role != role or not actor.strip():
        return IllegalTransitionError(
            f"only a {role} may accept these figures, with name and password",
            where=state.current,
            remedy="Call one; nothing is lost by waiting",
        )
    if "another_supervisor" in asked and actor in (state.operator, state.step.confirmed_by):
        return IllegalTransitionError(
            "the protocol asks for somebody other than the person who began the run or confirmed this step",
            where=state.current,
            remedy="Call another supervisor; nothing is lost by waiting",
        )
    return None


def describe_accepted(accepted: AcceptedDeviation) -> str:
    """Describe an acceptance: `coverage 0.896, allowed ≥ 0.9; accepted by Emmy (supervisor): the reason`."""
    figures = "; ".join(describe_judged(verdict) for verdict in accepted.verdicts)
    how = {"claimed": ", by claim", "pin": ", by PIN", "badge": ", by badge"}.get(accepted.identified, "")
    return f"{figures}; accepted by {accepted.by} ({accepted.role}{how}): {accepted.reason}"


@dataclass(frozen=True, slots=True)
class AcceptedGate:
    """An acceptance that a result depends on."""

    step: str
    title: str
    accepted: AcceptedDeviation

    @property
    def text(self) -> str:
        """`Camera calibration: coverage 0.896, allowed ≥ 0.9; accepted by …`."""
        return f"{self.title}: {describe_accepted(self.accepted)}"


def used_steps(protocol: Protocol, step: Step) -> frozenset[str]:
    """Return the earlier steps that a step's params name directly."""
    earlier = frozenset(protocol.step_ids[: protocol.index(step.id)])
    return earlier.intersection(_texts(step.params.model_dump(mode="json")))


def accepted_gates(protocol: Protocol, state: RunState) -> tuple[AcceptedGate, ...]:
    """Return every acceptance in force in a run, in the protocol's order."""
    found = ((step, state.steps[step.id].accepted) for step in protocol.steps)
    return tuple(AcceptedGate(step.id, step.title, accepted) for step, accepted in found if accepted is not None)


def depends_on(protocol: Protocol, state: RunState, step_id: str) -> tuple[AcceptedGate, ...]:
    """Return the acceptances that a step's result depends on: its own and, transitively, those of steps it uses."""
    reached: set[str] = set()
    waiting = [step_id]
    while waiting:
        name = waiting.pop()
        if name not in reached:
            reached.add(name)
            waiting += used_steps(protocol, protocol.step(name))
    return tuple(gate for gate in accepted_gates(protocol, state) if gate.step in reached)


def dependent_steps(protocol: Protocol, step_id: str) -> tuple[str, ...]:
    """Return the later steps that depend on this one, directly or not, in the protocol's order."""
    rests = {step_id}
    for step in protocol.steps[protocol.index(step_id) + 1 :]:
        if used_steps(protocol, step) & rests:
            rests.add(step.id)
    return tuple(name for name in protocol.step_ids if name in rests and name != step_id)


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for inner in value.values():
            yield from _texts(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _texts(inner)
