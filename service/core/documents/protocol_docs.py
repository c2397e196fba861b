"""Generates the texts of docs/reference/protocol.schema.json and of the lifecycle page; the caller writes them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping

from service.core.gates.measure_names import measure_name
from service.core.gates.verdict import limits
from service.core.protocol.models import Gate, Protocol, Step, protocol_json_schema
from service.core.protocol.step_params import StepParams
from service.core.run.lifecycle import ABORTED, COMPLETED, PAUSED, PHASES, SEPARATOR, STEP_RULES, transition_table


def schema_text(params_models: Mapping[str, type[StepParams]]) -> str:
    """The text of docs/reference/protocol.schema.json; `params_models` maps each step kind to its Params."""
    return json.dumps(protocol_json_schema(params_models), indent=2, ensure_ascii=False) + "\n"


def lifecycle_text(protocol: Protocol) -> str:
    """A Markdown page: a protocol's state machine, the phases of a step, and a table of the steps."""
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
    """Lines of a Mermaid diagram: the steps in order inside the run, with pause and end around it."""
    known = {step.id: step for step in steps}
    inside, around = dict[str, None](), dict[str, None]()  # ordered sets
    for trigger, source, target in transition_table(tuple(known)):
        origin, end = source.split(SEPARATOR)[0], target.split(SEPARATOR)[0]
        if trigger.startswith("redo_") or origin == end:
            continue  # redo arrows from every step would hide the rest; the page says it in words
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
    """Lines of a Mermaid diagram: the phases of a step."""
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
