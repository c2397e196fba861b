"""Generates the texts of reference pages from the models: the protocol's schema, the lifecycle, the ways on."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Literal

from service.core.gates import limits
from service.core.measure_names import measure_name
from service.core.protocol import Gate, Protocol, Step, protocol_json_schema
from service.core.records.run_events import GateVerdict
from service.core.recovery import REMEDIES, WayOn, planned_views, recovery_policy, takes_words, ways_on
from service.core.run.fold import initial_state
from service.core.run.lifecycle import (
    ABORTED,
    COMPLETED,
    PAUSED,
    PHASES,
    SEPARATOR,
    STEP_RULES,
    state_name,
    transition_table,
)
from service.core.run.state import Failure, RunState, StepState, change
from service.core.step_params import StepParams


def schema_text(params_models: Mapping[str, type[StepParams]]) -> str:
    """Return the text of docs/reference/protocol.schema.json; `params_models` maps each step kind to its Params."""
    return json.dumps(protocol_json_schema(params_models), indent=2, ensure_ascii=False) + "\n"


def lifecycle_text(protocol: Protocol) -> str:
    """Return a Markdown page: a protocol's state machine, the phases of a step, and a table of the steps."""
    yes = {True: "yes", False: ""}
    rows = [
        f"| {step.id} | {step.kind} | {step.title} | {yes[step.sign]} | {yes[step.skippable]} "
        f"| {yes[step.irreversible]} | {', '.join(step.requires)} | {_gates(step.gates)} |"
        for step in protocol.steps
    ]
    return "\n".join(
        [
            f"# The state machine of `{protocol.id}` {protocol.version}",
            "",
            "Generated from the table that the software runs on.",
            "",
            "## The run",
            "",
            *_mermaid(run_diagram(protocol.steps)),
            "",
            "A redo goes from any step back to itself or to an earlier one. It and every later step start afresh;",
            "what they had captured stays in the record as superseded. A redo is refused across an irreversible step",
            "that has begun. After a restart the state is the fold of the recorded events: a crash is not a state.",
            "",
            "## Within each step",
            "",
            *_mermaid(step_diagram()),
            "",
            "The same rules hold while a run is paused, so that work in progress can still report; nothing moves.",
            "",
            "## The steps",
            "",
            "| step | kind | title | signed | may be skipped | irreversible | requires | gates |",
            "|---|---|---|---|---|---|---|---|",
            *rows,
            "",
        ]
    )


def run_diagram(steps: Iterable[Step]) -> list[str]:
    """Return the lines of a Mermaid diagram: the steps in order inside the run, with pause and end around it."""
    known = {step.id: step for step in steps}
    inside, around = dict[str, None](), dict[str, None]()  # ordered sets
    for trigger, source, target in transition_table(tuple(known)):
        origin, end = source.split(SEPARATOR)[0], target.split(SEPARATOR)[0]
        if trigger.startswith("redo_") or origin == end:
            continue  # redo arrows from every step would hide the rest; the page says it in a sentence
        if origin in known and end in known:
            inside[f"        {origin} --> {end}: {trigger}"] = None
        elif not (origin == PAUSED and end == COMPLETED):
            around[f"    {_name(origin, known)} --> {_name(end, known)}: {trigger}"] = None
    return [
        "stateDiagram-v2",
        "    [*] --> run",
        '    state "step by step" as run {',
        f"        [*] --> {next(iter(known))}",
        *(f'        state "{step.id} (irreversible)" as {step.id}' for step in known.values() if step.irreversible),
        *inside,
        "    }",
        *around,
        f"    {COMPLETED} --> [*]",
        f"    {ABORTED} --> [*]",
    ]


def step_diagram() -> list[str]:
    """Return the lines of a Mermaid diagram: the phases of a step."""
    return [
        "stateDiagram-v2",
        f"    [*] --> {PHASES[0]}",
        *(f"    {rule.source} --> {rule.target}: {rule.trigger}" for rule in STEP_RULES),
        f"    {PHASES[-1]} --> [*]: advance",
    ]


def _name(state: str, steps: Iterable[str]) -> str:
    return "run" if state in steps else state


def _mermaid(lines: Iterable[str]) -> list[str]:
    return ["```mermaid", *lines, "```"]


def _gates(gates: tuple[Gate, ...]) -> str:
    return "; ".join(
        f"{measure_name(gate.measure)} {limits(gate.min, gate.max)} {gate.unit}".rstrip()
        + (f" (unless {gate.unless_skipped} is skipped)" if gate.unless_skipped else "")
        + (f" (or accepted by {gate.accept_by.replace('_', ' ')})" if gate.accept_by else "")
        for gate in gates
    )


_VIEW_S, _STEP_S = 10.0, 300.0
_BEGAN, _ENDED = "2026-01-01T08:00:00Z", "2026-01-01T08:05:00Z"


def ways_text(protocol: Protocol) -> str:
    """Return a Markdown page of choices by step kind and failure, with cost and loss, for each kind's first step."""
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
    """Return the state of a run that is at `step`, with every earlier step passed."""
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
