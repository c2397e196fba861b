"""A simulated Sony ILCE-7RM5 over PTP/IP: command-line options and main loop."""

from __future__ import annotations

import argparse

from simulators.serve import Termination
from simulators.sony_camera.body import SonyBody
from simulators.sony_camera.properties import Code
from simulators.sony_camera.server import SonyServer
from simulators.still_camera import add_arguments, body_options, image_source, serve_until_stopped

__all__ = ["add_arguments", "serve"]


def serve(args: argparse.Namespace) -> None:
    """Print the ready line and serve until SIGTERM."""
    termination = Termination()
    body = SonyBody(image_source(args), args.faults, body_options(args))
    body.properties.put(Code.BATTERY, args.battery)
    serve_until_stopped(SonyServer(args.host, args.port, body, args.faults), body, termination)
