"""Generates the text of docs/reference/ways_on.md: the ways on after every failure of every kind of step."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Literal

from service.core.gates.measure_names import measure_name
from service.core.protocol.models import Gate, Protocol, Step
from service.core.records.events import GateVerdict
from service.core.recovery.policy import recovery_policy
from service.core.recovery.ways_on import WayOn, planned_views, takes_words, ways_on
from service.core.recovery.words import REMEDIES
from service.core.run.fold import initial_state
from service.core.run.lifecycle import state_name
from service.core.run.state import Failure, RunState, StepState
from service.core.run.state_transitions import change

_VIEW_S, _STEP_S = 10.0, 300.0
_BEGAN, _ENDED = "2026-01-01T08:00:00Z", "2026-01-01T08:05:00Z"


def ways_text(protocol: Protocol) -> str:
    """A Markdown page of choices by step kind and failure, with cost and loss, for the first step of each kind."""
    shown: dict[str, Step] = {}
    for step in protocol.steps:
        shown.setdefault(step.kind, step)
    requiring = next((step for step in protocol.steps if step.requires), None)
    lines = [
        "# Ways on",
        "",
        "What a person can do when a step is outside its limits, fails or cannot begin. Generated from the code for"
        f" `{protocol.id}`.",
        f"The times are examples: {_VIEW_S:.0f} s for a view, {_STEP_S / 60:.0f} min for a step without views.",
        "A run shows the times that it has measured itself.",
        "The first choice is the recommended one. A choice that is not possible says why.",
        "",
        "A run can also be paused at any time, and any step that has begun can be done again unless an irreversible",
        "step has begun since.",
    ]
    for step in shown.values():
        lines += ["", f"## {step.kind}", "", f"Here: {step.id} ({step.title}).", "", *_TABLE_HEAD]
        for failure, state in _failures(protocol, step):
            lines += _rows(failure, ways_on(protocol, state))
    if requiring is not None:
        lines += ["", "## A step that requires others", "", f"Here: {requiring.id} ({requiring.title}).", ""]
        lines += _TABLE_HEAD
        for failure, changed, state in _requirements(protocol, requiring):
            lines += _rows(failure, ways_on(changed, state))
    lines += ["", "## Errors", "", "The words of the choice `confirm` begin with what helps.", "", *_errors(), ""]
    return "\n".join(lines)


_TABLE_HEAD = ("| failure | choice | what it does | takes | loses |", "|---|---|---|---|---|")


def _rows(failure: str, ways: tuple[WayOn, ...]) -> Iterator[str]:
    for number, way in enumerate(ways):
        first = failure if number == 0 else ""
        if way.available:
            yield f"| {first} | {way.verb} | {way.words} | {takes_words(way.minutes)} | {way.loses} |"
        else:
            yield f"| {first} | ({way.verb}) | {way.words} | | Not possible: {way.why_not} |"


def _errors() -> Iterator[str]:
    yield "| error | what helps | before the operator is asked |"
    yield "|---|---|---|"
    fields = Step.model_fields["recovery"].get_default()
    for name, remedy in REMEDIES.items():
        retried = recovery_policy(fields, name, 1) == "retry"
        yield f"| {name} | {remedy} | {f'tried again {fields.retries} times' if retried else ''} |"


def _failures(protocol: Protocol, step: Step) -> Iterator[tuple[str, RunState]]:
    at = _at(protocol, step, "recovering")
    kinds: Mapping[str, list[Gate]] = {
        "a gate that nobody may accept": [gate for gate in step.gates if gate.accept_by is None],
        "a gate that may be accepted": [gate for gate in step.gates if gate.accept_by is not None],
    }
    for name, gates in kinds.items():
        if gates:
            verdicts = tuple(_failed(gate) for gate in gates[:1])
            yield f"{name}, such as “{measure_name(gates[0].measure)}”", change(at, step.id, verdicts=verdicts)
    again = step.repeated
    device = "UnreadableFileError" if step.kind.endswith("_import") else "DeviceFaultError"
    errors = ((device, "a device fails", again.device), ("ComputeError", "a computation fails", again.computes))
    for error, what, possible in errors:
        if possible:
            yield f"{what}, such as {error}", change(at, step.id, failure=Failure(1, error, what, "ask"))


def _requirements(protocol: Protocol, step: Step) -> Iterator[tuple[str, Protocol, RunState]]:
    needed = step.requires[0]
    state = change(_at(protocol, step, "ready"), needed, skipped=True)
    yield f"{needed} was skipped", protocol, state
    between = protocol.index(needed) + 1
    if between < protocol.index(step.id):
        final = protocol.steps[between].model_copy(update={"irreversible": True, "sign": True})
        steps = (*protocol.steps[:between], final, *protocol.steps[between + 1 :])
        sealed = protocol.model_copy(update={"steps": steps})
        yield f"{needed} was skipped, and an irreversible step has begun since", sealed, state


def _failed(gate: Gate) -> GateVerdict:
    value = gate.min - 1 if gate.min is not None else (gate.max or 0.0) + 1
    return GateVerdict(
        measure=gate.measure, value=value, minimum=gate.min, maximum=gate.max, unit=gate.unit, passed=False
    )


def _at(protocol: Protocol, step: Step, phase: Literal["ready", "recovering"]) -> RunState:
    """The state of a run that is at `step`, with every earlier step passed."""
    steps = {
        s.id: StepState(
            s.id,
            phase="passed",
            gates_passed=True,
            started_utc=_BEGAN,
            ended_utc=_ENDED,
            worked_s=_STEP_S,
            captured={f"view{i}": i for i in range(planned_views(s))},
        )
        for s in protocol.steps[: protocol.index(step.id) + 1]
    }
    now = replace(steps[step.id], phase="recovering", gates_passed=False, ended_utc="")
    if phase == "ready":
        now = StepState(step.id, phase="ready")
    begun = initial_state(protocol)
    return replace(
        begun,
        steps={**begun.steps, **steps, step.id: now},
        current=step.id,
        machine_state=state_name(step.id, phase),
        seq=1,
        run_id="example",
        operator="technician",
        view_gaps_s=(_VIEW_S,),
    )
