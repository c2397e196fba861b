"""`orthocapture protocol` and `plan`: check a protocol file, print its documents, and plan its viewpoints."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from service.cli.common import (
    DEFAULT_DATA,
    PROTOCOL_HELP,
    DataOption,
    JsonOption,
    RunArgument,
    console,
    print_document,
    print_json,
    print_table,
    protocol_file,
    reporting_errors,
)
from service.core.documents import lifecycle_text, schema_text, ways_text
from service.core.errors import ConfigurationError
from service.core.protocol import Step, load_protocol
from service.core.run.fold import fold
from service.core.words import counted
from service.rig import load_rig
from service.run_start import recorded_run
from service.station import devices_of, layout_of
from service.steps import params_models
from service.steps.kinds import calibration
from service.steps.protocol_check import require_devices, require_plausible
from service.store.store import Store

if TYPE_CHECKING:
    from service.steps.motion import StepPlan
    from service.steps.plan_preview import BoardPreview

# --- `protocol`: check a protocol file, and print schema, diagram and ways on -------------------------------------

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


# --- `plan`: what a capture step will do, and which views would help a run most -----------------------------------

plan_app = typer.Typer(no_args_is_help=True, help="Plan viewpoints, before and during a capture.")


@plan_app.command("show")
def show_command(
    protocol: Annotated[Path, typer.Argument(help=PROTOCOL_HELP)],
    rig: Annotated[Path, typer.Option("--rig", help="The rig file; `collision: {arm: …}` names the arm.")],
    step: Annotated[str | None, typer.Option("--step", help="Only this capture step.")] = None,
    json: JsonOption = False,
) -> None:
    """Show the viewpoints that the arm can reach, their order and time, and the use of board images. No device."""
    from service.steps.plan_preview import preview_board_poses, preview_plans  # noqa: PLC0415 - planning, for this command alone

    with reporting_errors(json):
        loaded = load_protocol(protocol_file(protocol), params_models())
        rig_file = load_rig(rig)
        steps = [loaded.protocol.step(step)] if step else list(loaded.protocol.steps)
        answers: dict[str, list[dict[str, Any]]] = {}
        for one in steps:
            plans = preview_plans(loaded.protocol, one, rig_file, lambda station: layout_of(rig_file, station))
            if plans:
                answers[one.id] = [_motion_record(plan) for plan in plans]
            board = preview_board_poses(loaded.protocol, one, rig_file, lambda station: layout_of(rig_file, station))
            if board is not None:
                answers[one.id] = [_board_record(one, board)]
        if not answers:
            raise ConfigurationError(
                "there is nothing to plan",
                where=str(protocol),
                remedy="Name a step of kind viewpoint_capture or calibration",
            )
    if json:
        print_json(answers)
        return
    for name, plans in answers.items():
        for plan in plans:
            console.print(f"{name}, {plan['station']}: {plan['text']}")
            if "prediction" in plan:
                console.print(_coverage_text(plan["prediction"]["coverage_map"]), highlight=False)


def _motion_record(plan: StepPlan) -> dict[str, Any]:
    (station,) = plan.motions
    return {**station.model_dump(mode="json"), "text": plan.text}


def _board_record(step: Step, board: BoardPreview) -> dict[str, Any]:
    station = step.params_as(calibration.Params).board_poses
    return {
        "station": "" if station is None else station.station,
        "text": board.text,
        "prediction": board.prediction.model_dump(mode="json"),
        "poses": board.T_base_camera.round(6).tolist(),
    }


def _coverage_text(counts: Sequence[Sequence[int]]) -> str:
    """Return the number of corners expected in each cell of the image, row by row; a dot for none."""
    width = max(len(str(n)) for row in counts for n in row)
    return "\n".join("    " + " ".join((str(n) if n else "·").rjust(width) for n in row) for row in counts)


@plan_app.command("next")
def next_command(
    run: RunArgument = "latest",
    data: DataOption = DEFAULT_DATA,
    json: JsonOption = False,
) -> None:
    """Show the views that would bring a run's predicted error under its limit soonest, as of its last capture."""
    from service.cli.runs import next_best_views  # noqa: PLC0415 - the record of a run, for this command alone

    with reporting_errors(json), Store.open(data, create=False) as store:
        run_id = store.find_run(run)
        protocol, _ = recorded_run(store, run_id)
        state = fold(protocol, store.events(run_id))
    views = next_best_views(state)
    if json:
        print_json({"run": run_id, "next_best_views": [view.plain() for view in views]})
        return
    if not views:
        console.print("No capture step has asked for more views.")
        return
    table = Table(title="Views to take next", title_justify="left")
    for heading in ("viewpoint", "predicted error after it (mm)", "coverage after it"):
        table.add_column(heading)
    for view in views:
        table.add_row(view.viewpoint, f"{view.predicted_error_mm:.3f}", f"{100 * view.coverage:.0f} %")
    print_table(table)
