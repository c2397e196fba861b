"""The texts of docs/protocol.schema.json and of the lifecycle page, generated; the caller writes them."""

from __future__ import annotations

import json
from collections.abc import Mapping

from pydantic import BaseModel

from service.core.gates import limits
from service.core.lifecycle import diagram
from service.core.protocol import Gate, Protocol, protocol_json_schema


def schema_text(params_models: Mapping[str, type[BaseModel]]) -> str:
    """docs/protocol.schema.json."""
    return json.dumps(protocol_json_schema(params_models), indent=2, ensure_ascii=False) + "\n"


def lifecycle_text(protocol: Protocol) -> str:
    """A Markdown page with the state machine of a protocol and a table of its steps."""
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
            "| step | kind | title | signed | may be skipped | irreversible | requires | gates |",
            "|---|---|---|---|---|---|---|---|",
            *rows,
            "",
            "```mermaid",
            diagram(protocol.step_ids).rstrip(),
            "```",
            "",
        ]
    )


def _gates(gates: tuple[Gate, ...]) -> str:
    return "; ".join(f"{gate.measure} {limits(gate.min, gate.max)} {gate.unit}".rstrip() for gate in gates)
