"""Which steps depend on a step that passed because a person accepted figures outside their limits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from service.core.gates.acceptance import describe_accepted
from service.core.protocol.models import Protocol, Step
from service.core.run.state import AcceptedDeviation, RunState


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
    """The earlier steps that a step's params name directly."""
    earlier = frozenset(protocol.step_ids[: protocol.index(step.id)])
    return earlier.intersection(_texts(step.params.model_dump(mode="json")))


def accepted_gates(protocol: Protocol, state: RunState) -> tuple[AcceptedGate, ...]:
    """Every acceptance in force in a run, in the protocol's order."""
    found = ((step, state.steps[step.id].accepted) for step in protocol.steps)
    return tuple(AcceptedGate(step.id, step.title, accepted) for step, accepted in found if accepted is not None)


def depends_on(protocol: Protocol, state: RunState, step_id: str) -> tuple[AcceptedGate, ...]:
    """The acceptances that a step's result depends on: its own and, transitively, those of the steps it uses."""
    reached: set[str] = set()
    waiting = [step_id]
    while waiting:
        name = waiting.pop()
        if name not in reached:
            reached.add(name)
            waiting += used_steps(protocol, protocol.step(name))
    return tuple(gate for gate in accepted_gates(protocol, state) if gate.step in reached)


def dependent_steps(protocol: Protocol, step_id: str) -> tuple[str, ...]:
    """The later steps that depend on this one, directly or not, in the protocol's order."""
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
