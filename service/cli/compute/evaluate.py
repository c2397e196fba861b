"""`orthocapture evaluate`: compare a reconstructed surface with the ground truth."""

from __future__ import annotations

import typer

from service.cli.compute.evaluate_chamfer import chamfer_command

evaluate_app = typer.Typer(
    help="Compare a reconstructed surface with the ground truth.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
evaluate_app.command("chamfer")(chamfer_command)
