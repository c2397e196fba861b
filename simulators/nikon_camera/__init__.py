"""A simulated Nikon Z over PTP/IP, which states what a real body was recorded to state: options and main loop."""

from __future__ import annotations

import argparse

from simulators import still_camera
from simulators.nikon_camera.body import NikonBody, names, recorded_table, replayed_table
from simulators.nikon_camera.responder import NikonResponder
from simulators.ptpip.server import PtpIpServer
from simulators.recordings import add_replay, not_recorded
from simulators.serve import Termination


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the camera's options."""
    still_camera.add_arguments(parser)
    parser.add_argument("--recorded", choices=names(), default="z6_2-v1.00", help="which body it is")
    add_replay(parser)


def serve(args: argparse.Namespace) -> None:
    """Print the ready line and serve until SIGTERM."""
    termination = Termination()
    table = replayed_table(args.replay, args.replayed) if args.replay else recorded_table(args.recorded)
    body = NikonBody(table, still_camera.image_source(args), args.faults, still_camera.body_options(args))
    server = PtpIpServer(args.host, args.port, body.table.model, NikonResponder(body, args.faults), args.faults)
    still_camera.serve_until_stopped(server, body, termination, not_recorded(args))
