"""Which pages are made from the code, and their texts."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from docs.generate.commands import commands_text
from docs.generate.events import events_text
from docs.generate.files import protocol_text, rig_text
from docs.generate.jobs import jobs_text
from docs.generate.roles import roles_text
from docs.generate.steps import steps_text
from service.core.documents import lifecycle_text, schema_text, ways_text
from service.core.protocol import Protocol, load_protocol
from service.steps import params_models

REFERENCE = Path(__file__).parents[1] / "reference"
PROTOCOLS = Path(__file__).parents[2] / "protocols"


def shipped_protocols() -> Mapping[str, Protocol]:
    """The protocols that come with the program, by the name of their file."""
    files = sorted(PROTOCOLS.glob("*.yaml"))
    return {path.name: load_protocol(path, params_models()).protocol for path in files}


def pages() -> Mapping[str, str]:
    """The text of every generated page by its name in docs/reference."""
    protocols = shipped_protocols()
    exvivo = protocols["exvivo_spine.yaml"]
    return {
        "protocol.md": protocol_text(),
        "rig.md": rig_text(),
        "steps.md": steps_text(protocols),
        "events.md": events_text(),
        "roles.md": roles_text(),
        "commands.md": commands_text(),
        "protocol.schema.json": schema_text(params_models()),
        "state_machine.md": lifecycle_text(exvivo),
        "ways_on.md": ways_text(exvivo),
        "jobs.md": jobs_text(),
    }
