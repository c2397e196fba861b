"""`orthocapture`: the command line, assembled from one file per command or group of commands."""

from __future__ import annotations

import importlib
import logging
import os
from difflib import get_close_matches
from importlib.metadata import version
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

# Imported on demand, so that `status` need not load the numerics that `register` needs.
_COMMANDS = {
    "demo": "service.cli.run.demo:demo_command",
    "serve": "service.cli.site.serve:serve_command",
    "run": "service.cli.run.commands:run_command",
    "resume": "service.cli.run.commands:resume_command",
    "import": "service.cli.run.import_command:import_command",
    "act": "service.cli.run.act:act_command",
    "note": "service.cli.run.act:note_command",
    "status": "service.cli.run.commands:status_command",
    "runs": "service.cli.evidence.runs:runs_command",
    "compare": "service.cli.evidence.runs:compare_command",
    "history": "service.cli.evidence.runs:history_command",
    "worker": "service.cli.site.worker:worker_command",
    "doctor": "service.cli.site.doctor:doctor_command",
    "calibrate": "service.cli.compute.calibrate:calibrate_app",
    "sfm": "service.cli.compute.sfm:sfm_command",
    "register": "service.cli.compute.register:register_command",
    "spheres": "service.cli.compute.spheres:spheres_command",
    "layout": "service.cli.compute.layout:layout_command",
    "fuse": "service.cli.compute.fuse:fuse_command",
    "evaluate": "service.cli.compute.evaluate:evaluate_app",
    "simulate": "service.cli.site.simulate:simulate_command",
    "audit": "service.cli.evidence.audit:audit_app",
    "store": "service.cli.evidence.store:store_app",
    "replay": "service.cli.evidence.replay:replay_command",
    "export": "service.cli.evidence.export:export_command",
    "protocol": "service.cli.site.protocol:protocol_app",
    "plan": "service.cli.site.plan:plan_app",
}
_SETTINGS: dict[str, dict[str, Any]] = {
    "simulate": {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}
}


class _Commands(TyperGroup):
    """The group of all commands, each imported on first use."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Names in the order of the help text."""
        return list(_COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command of this name, or None."""
        if cmd_name not in _COMMANDS:
            return None
        # Shell completion asks for names at every key press, and importing every command would take seconds.
        return TyperCommand(cmd_name, callback=None) if ctx.resilient_parsing else _loaded(cmd_name)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command that was typed, imported; suggests a similar name if there is no such command."""
        name = args[0]
        if name in _COMMANDS:
            return name, _loaded(name), args[1:]
        near = get_close_matches(name, _COMMANDS, n=1)
        if near and not ctx.resilient_parsing:
            ctx.fail(f"No such command {name!r}. Did you mean {near[0]!r}?")
        return super().resolve_command(ctx, args)


def _loaded(name: str) -> Any:
    module, _, attribute = _COMMANDS[name].partition(":")
    found = getattr(importlib.import_module(module), attribute)
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
        typer.echo(f"orthocapture {version('orthocapture')}")
        raise typer.Exit


@app.callback()
def orthocapture(
    *,
    _version: Annotated[
        bool, typer.Option("--version", help="Show the version and exit.", callback=_tell_version, is_eager=True)
    ] = False,
) -> None:
    """Acquire surgical vision data sets that are accurate to a fraction of a millimetre, with proof of origin."""


def main() -> None:
    """Entry point of the distribution."""
    # With small matrices and many processes, threads of the linear algebra wait for each other and are ten times
    # slower on a busy machine. The library reads this when it is loaded, here and in every child process.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(name)s %(levelname)s %(message)s")
    app()


if __name__ == "__main__":
    main()
