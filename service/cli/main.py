"""`orthocapture`: the command line, put together from one file a group of commands."""

from __future__ import annotations

import logging

import typer

from service.cli.audit import audit_app
from service.cli.demo import demo_command
from service.cli.doctor import doctor_command
from service.cli.protocol import protocol_app
from service.cli.register import register_command
from service.cli.run import act_command, resume_command, run_command, status_command
from service.cli.simulate import simulate_command
from service.cli.worker import worker_command

app = typer.Typer(
    name="orthocapture",
    help="Acquire a surgical vision data set that is accurate to a fraction of a millimetre, with the proof.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.command("demo")(demo_command)
app.command("run")(run_command)
app.command("resume")(resume_command)
app.command("act")(act_command)
app.command("status")(status_command)
app.command("worker")(worker_command)
app.command("doctor")(doctor_command)
app.command("register")(register_command)
app.command(
    "simulate", context_settings={"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}
)(simulate_command)
app.add_typer(audit_app)
app.add_typer(protocol_app)


def main() -> None:
    """Entry point of the distribution."""
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(name)s %(levelname)s %(message)s")
    app()


if __name__ == "__main__":
    main()
