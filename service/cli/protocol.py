"""`orthocapture protocol`: check a protocol file, and print schema, diagram and ways on."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.common import (
    PROTOCOL_HELP,
    JsonOption,
    console,
    print_document,
    print_json,
    protocol_file,
    reporting_errors,
)
from service.core.documents import lifecycle_text, schema_text, ways_text
from service.core.protocol import load_protocol
from service.core.words import counted
from service.rig import load_rig
from service.station import devices_of
from service.steps import params_models
from service.steps.protocol_check import require_devices, require_plausible

protocol_app = typer.Typer(name="protocol", help="Check a protocol file before it is used.", no_args_is_help=True)


@protocol_app.command("check")
def check_command(
    file: Annotated[Path, typer.Argument(help=PROTOCOL_HELP)],
    rig: Annotated[
        Path | None, typer.Option("--rig", help="Also check that this rig has its stations and devices.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Check a protocol and report every problem with file, line and field."""
    with reporting_errors(json):
        file = protocol_file(file)
        loaded = load_protocol(file, params_models())
        protocol = loaded.protocol
        site = None if rig is None else load_rig(rig)
        if site is None:
            require_plausible(loaded, str(file))
        else:
            devices = devices_of(site)
            require_plausible(loaded, str(file), site.section, devices)
            require_devices(loaded.protocol, site, devices)
        if json:
            steps = [{"id": s.id, "kind": s.kind, "irreversible": s.irreversible} for s in protocol.steps]
            print_json({"id": protocol.id, "version": protocol.version, "sha256": loaded.sha256, "steps": steps})
            return
        console.print(f"{file!s} is valid: {protocol.id} {protocol.version}, {counted(len(protocol.steps), 'step')}")
        for step in protocol.steps:
            marks = ", ".join(m for m, on in (("irreversible", step.irreversible), ("signed", step.sign)) if on)
            console.print(f"  {step.id:<26} {step.kind:<20} {marks}")


@protocol_app.command("schema")
def schema_command() -> None:
    """Print the JSON Schema of protocol files, for editors."""
    print_document(schema_text(params_models()))


@protocol_app.command("diagram")
def diagram_command(file: Annotated[Path, typer.Argument(help=PROTOCOL_HELP)]) -> None:
    """Print the state machine of a protocol as a page with Mermaid diagrams."""
    with reporting_errors():
        print_document(lifecycle_text(load_protocol(protocol_file(file), params_models()).protocol))


@protocol_app.command("ways")
def ways_command(file: Annotated[Path, typer.Argument(help=PROTOCOL_HELP)]) -> None:
    """Print the ways on after every failure of a protocol's steps, with time and loss, as a page of tables."""
    with reporting_errors():
        print_document(ways_text(load_protocol(protocol_file(file), params_models()).protocol))
