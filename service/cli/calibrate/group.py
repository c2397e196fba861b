"""`orthocapture calibrate`: intrinsics and hand-eye calibration from any board images, without a run."""

from __future__ import annotations

import typer

from service.cli.calibrate.hand_eye import hand_eye_command
from service.cli.calibrate.intrinsics import intrinsics_command

calibrate_app = typer.Typer(
    help="Calibrate a camera and its mounting from images of a board.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
calibrate_app.command("intrinsics")(intrinsics_command)
calibrate_app.command("hand-eye")(hand_eye_command)
