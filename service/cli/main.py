"""`orthocapture`: the command line, put together from one file a group of commands."""

from __future__ import annotations

import importlib
import logging
import os
from typing import Any

import typer
from typer.core import TyperGroup

# Loaded when asked for: `status` must not wait for the numerics that `register` needs.
_COMMANDS = {
    "demo": "service.cli.demo:demo_command",
    "serve": "service.cli.serve:serve_command",
    "run": "service.cli.run:run_command",
    "resume": "service.cli.run:resume_command",
    "import": "service.cli.importing:import_command",
    "act": "service.cli.run:act_command",
    "status": "service.cli.run:status_command",
    "worker": "service.cli.worker:worker_command",
    "doctor": "service.cli.doctor:doctor_command",
    "calibrate": "service.cli.calibrate:calibrate_app",
    "sfm": "service.cli.sfm:sfm_command",
    "register": "service.cli.register:register_command",
    "spheres": "service.cli.spheres:spheres_command",
    "layout": "service.cli.layout:layout_command",
    "simulate": "service.cli.simulate:simulate_command",
    "audit": "service.cli.audit:audit_app",
    "store": "service.cli.store_backup:store_app",
    "replay": "service.cli.replay:replay_command",
    "protocol": "service.cli.protocol:protocol_app",
    "plan": "service.cli.plan:plan_app",
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
        module, _, name = _COMMANDS[cmd_name].partition(":")
        found = getattr(importlib.import_module(module), name)
        if isinstance(found, typer.Typer):
            return typer.main.get_group(found)
        alone = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
        alone.command(cmd_name, context_settings=_SETTINGS.get(cmd_name))(found)
        return typer.main.get_command(alone)


app = typer.Typer(
    name="orthocapture", cls=_Commands, no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False
)


@app.callback()
def orthocapture() -> None:
    """Acquire a surgical vision data set that is accurate to a fraction of a millimetre, with the proof."""


def main() -> None:
    """Entry point of the distribution."""
    # The matrices are small and the processes many: threads of the linear algebra wait for one another, ten times
    # slower on a busy machine. It reads this when it is loaded, here and in every process started from here.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(name)s %(levelname)s %(message)s")
    app()


if __name__ == "__main__":
    main()
