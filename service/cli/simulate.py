"""`orthocapture simulate`: becomes a simulator process; this package imports none of them."""

from __future__ import annotations

import os
import sys

import typer


def simulate_command(context: typer.Context) -> None:
    """Start a simulated device (ur, camera, scanner, ct, lightbox) or a whole rig, until it is terminated.

    It prints one line of JSON with its addresses when it is ready. `orthocapture simulate rig --help` lists options.
    """
    os.execv(sys.executable, [sys.executable, "-m", "simulators", *(context.args or ["--help"])])
