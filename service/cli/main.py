"""`orthocapture`: the command line, assembled from a file for the commands of each subject."""

from __future__ import annotations

import importlib
import os
import sys
import traceback
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from difflib import get_close_matches
from importlib.metadata import version
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from service.cli.ending import ExitStatus
from service.core.loading import begin_loading, end_loading
from service.core.words import shown, shown_lines
from service.logs import show_own_words_only


@dataclass(frozen=True, slots=True)
class _Command:
    """The place of a command, and its line in the list of commands: the first paragraph of its own help."""

    place: str
    line: str


# Imported on demand: `status` need not load the numerics that `register` needs, and `--help` none of them.
_COMMANDS = {
    "demo": _Command(
        "service.cli.demo:demo_command",
        "Run the demonstration protocol on a simulated rig and show the results. Takes a few minutes.",
    ),
    "serve": _Command(
        "service.cli.serve:serve_command",
        "Serve the guided screen and the audit. Runs continue when this command ends; stop them on the screen.",
    ),
    "run": _Command(
        "service.cli.run:run_command",
        "Run a protocol step by step. Nothing moves before you have confirmed it.",
    ),
    "resume": _Command(
        "service.cli.run:resume_command",
        "Continue a run after a crash, a power failure or a pause; nothing captured is lost or taken twice.",
    ),
    "import": _Command(
        "service.cli.import_command:import_command",
        "Import photographs, scan and CT that were captured earlier; register and evaluate them as a run.",
    ),
    "act": _Command(
        "service.cli.act:act_command",
        "Answer or stop a run that another terminal drives. A confirmation ticks the whole checklist.",
    ),
    "draw-region": _Command(
        "service.cli.act:draw_region_command",
        "Draw a region in which the CT or the scan counts; the next fusion uses it, as one drawn on the 3D view.",
    ),
    "cancel": _Command(
        "service.cli.act:cancel_command",
        "End one computation of a run. The step that waits for it asks what to do, as if it had failed.",
    ),
    "note": _Command(
        "service.cli.act:note_command",
        "Write a note on a step of a run, with or without a photograph; the run goes on as it was.",
    ),
    "status": _Command("service.cli.runs:status_command", "Show the state of a run: steps, gates, deviations."),
    "runs": _Command(
        "service.cli.runs:runs_command", "List the recorded runs, newest first: all, or those that match."
    ),
    "compare": _Command(
        "service.cli.runs:compare_command",
        "Compare two runs: protocol, gates, figures, accuracy, calibration, durations, deviations.",
    ),
    "history": _Command(
        "service.cli.runs:history_command",
        "Print calibration and accuracy over time for each camera, lens and arm, as CSV.",
    ),
    "worker": _Command(
        "service.cli.worker:worker_command",
        "Compute jobs: calibration, spheres, structure from motion, registration; one job per core at once.",
    ),
    "doctor": _Command(
        "service.cli.doctor:doctor_command",
        "Open every device of a rig; report versions, clock offsets, free space and problems.",
    ),
    "dicom-listen": _Command(
        "service.cli.worker:dicom_listen_command",
        "Receive CT series and segmentations that a CT suite sends (DICOM C-STORE), until it is terminated.",
    ),
    "calibrate": _Command(
        "service.cli.calibrate:calibrate_app", "Calibrate a camera and its mounting from images of a board."
    ),
    "import-ros": _Command(
        "service.cli.conversion:import_ros_command",
        "Take images, robot poses, camera and mount from a ROS 2 recording; the files fit the other commands.",
    ),
    "develop": _Command(
        "service.cli.conversion:develop_command",
        "Develop raw files to linear TIFFs of 16 bits, always in the same way; needs the extra `raw`.",
    ),
    "sfm": _Command(
        "service.cli.sfm:sfm_command",
        "Estimate camera poses with fixed, calibrated intrinsics; use the model with register --estimate-scale.",
    ),
    "register": _Command(
        "service.cli.register:register_command",
        "Register posed images with a scan by the spheres visible in both, and report the accuracy.",
    ),
    "spheres": _Command(
        "service.cli.spheres:spheres_command",
        "Find every sphere of a given radius in a mesh or point cloud, with its covariance and fit.",
    ),
    "layout": _Command(
        "service.cli.spheres:layout_command",
        "Check how well the spheres can be told apart, and suggest which to move. Exit status 1: some must be moved.",
    ),
    "fuse": _Command(
        "service.cli.fuse:fuse_command",
        "Fuse a CT mesh and a scan: the CT in the wound, the scan outside, blended between.",
    ),
    "evaluate": _Command(
        "service.cli.evaluate:evaluate_app", "Compare a reconstructed surface with the ground truth."
    ),
    "benchmark": _Command("service.cli.benchmark:benchmark_app", "Compare methods on an exported data set."),
    "simulate": _Command(
        "service.cli.simulate:simulate_command",
        "Start a simulated device (ur, kuka, camera, gige and others) or a whole rig, until it is terminated.",
    ),
    "audit": _Command(
        "service.cli.audit:audit_app",
        "Show, verify, sign, report and export the recorded evidence of a run.",
    ),
    "store": _Command("service.cli.store:store_app", "Maintain the folder that holds the evidence."),
    "replay": _Command(
        "service.cli.replay:replay_command",
        "Compute calibration, registration and evaluation again from the recorded files, and compare.",
    ),
    "export": _Command(
        "service.cli.export:export_command",
        "Write the data set of a completed run in a format that others read: images, poses, depth, masks, mesh.",
    ),
    "accounts": _Command("service.cli.store:accounts_app", "Maintain the accounts of a site."),
    "protocol": _Command("service.cli.protocol:protocol_app", "Check a protocol file before it is used."),
    "plan": _Command("service.cli.protocol:plan_app", "Plan viewpoints, before and during a capture."),
}
# Under which heading the help lists each command; the order is that of the help.
_GROUPS = {
    "Capture": (
        "demo", "run", "resume", "import", "status", "act", "note", "plan", "protocol", "draw-region", "cancel",
    ),
    "Evidence and data sets": ("runs", "compare", "history", "audit", "replay", "export"),
    "Calibration and computing": (
        "calibrate", "sfm", "register", "spheres", "layout", "fuse", "develop", "import-ros", "evaluate", "worker",
    ),
    "Site": ("serve", "doctor", "accounts", "store", "dicom-listen"),
    "Development": ("simulate", "benchmark"),
}  # fmt: skip
_GROUP_OF = {name: group for group, names in _GROUPS.items() for name in names}
_SETTINGS: dict[str, dict[str, Any]] = {
    "simulate": {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}
}


@contextmanager
def _usage_escaped() -> Generator[None]:
    """Escape what was typed wrongly before Typer repeats it on the terminal."""
    try:
        yield
    except Exception as error:
        if isinstance(message := getattr(error, "message", None), str):
            vars(error)["message"] = shown(message)
        raise


class _Commands(TyperGroup):
    """The group of all commands, each imported on first use."""

    def make_context(self, *words: Any, **options: Any) -> Any:
        """Return the options before the command."""
        with _usage_escaped():
            return super().make_context(*words, **options)

    def invoke(self, ctx: Any) -> Any:
        """Read the options of the command and run it."""
        with _usage_escaped():
            return super().invoke(ctx)

    def list_commands(self, ctx: Any) -> list[str]:
        """Return names in the order of the help text."""
        return list(_GROUP_OF)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return the name and the line of a command, for help and shell completion; None if there is no such command.

        Importing every command would take seconds. The one that was typed comes from `resolve_command`.
        """
        if cmd_name not in _COMMANDS:
            return None
        return TyperCommand(cmd_name, help=_COMMANDS[cmd_name].line, rich_help_panel=_GROUP_OF[cmd_name])

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command that was typed, imported; suggests a similar name if there is no such command."""
        name = args[0]
        if name in _COMMANDS:
            return name, _loaded(name), args[1:]
        near = get_close_matches(name, _COMMANDS, n=1)
        if near and not ctx.resilient_parsing:
            ctx.fail(f"No such command {name!r}. Did you mean {near[0]!r}?")
        return super().resolve_command(ctx, args)


def _loaded(name: str) -> Any:
    module, _, attribute = _COMMANDS[name].place.partition(":")
    found = getattr(importlib.import_module(module), attribute)
    end_loading()
    if isinstance(found, typer.Typer):
        group = typer.main.get_group(found)
        group.name = name
        return group
    alone = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    alone.command(name, context_settings=_SETTINGS.get(name))(found)
    return typer.main.get_command(alone)


app = typer.Typer(name="orthocapture", cls=_Commands, no_args_is_help=True, pretty_exceptions_enable=False)


def _tell_version(asked: bool) -> None:
    if asked:
        sys.stdout.write(f"orthocapture {version('orthocapture')}\n")
        raise typer.Exit


@app.callback()
def orthocapture(
    *,
    _version: Annotated[
        bool, typer.Option("--version", help="Show the version and exit.", callback=_tell_version, is_eager=True)
    ] = False,
    allow_mount: Annotated[
        bool,
        typer.Option(
            "--allow-mount", help="Write into a data folder on any file system, also one that other machines mount."
        ),
    ] = False,
) -> None:
    """Acquire surgical vision data sets that are accurate to a fraction of a millimetre, with proof of origin."""
    if allow_mount:
        from service.store.data_folder import ALLOW  # noqa: PLC0415 - seldom needed

        os.environ[ALLOW] = "1"  # for the processes, too, that a command starts


def main() -> None:
    """Run the command line; the entry point of the distribution."""
    begin_loading()  # until the command is loaded
    # With small matrices and many processes, threads of the linear algebra wait for each other and are ten times
    # slower on a busy machine. The library reads this when it is loaded, here and in every child process.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    show_own_words_only()
    try:
        app()
    except Exception:  # noqa: BLE001 - a fault of this program; its text may come from a device or a file
        sys.stderr.write(shown_lines(traceback.format_exc()))
        sys.exit(ExitStatus.FAILED)


if __name__ == "__main__":
    main()
