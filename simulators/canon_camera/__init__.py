"""A simulated Canon EOS R5 over PTP/IP, or another EOS that was recorded: command-line options and main loop."""

from __future__ import annotations

import argparse

from simulators import still_camera
from simulators.canon_camera.body import CanonBody
from simulators.canon_camera.recorded import names, recording_of, replayed_table
from simulators.canon_camera.responder import CanonResponder
from simulators.ptpip.server import PtpIpServer
from simulators.recordings import add_replay, not_recorded
from simulators.serve import Termination


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the camera's options."""
    still_camera.add_arguments(parser)
    parser.add_argument("--lens-switch", choices=("MF", "AF"), default="MF", help="switch on the lens")
    parser.add_argument("--mode-dial", choices=("M", "Av"), default="M", help="mode dial of the body")
    parser.add_argument("--no-card", action="store_true", help="there is no card in the camera")
    parser.add_argument(
        "--recorded", choices=names(), metavar="BODY", help="serve what this body was recorded to state"
    )
    add_replay(parser)


def serve(args: argparse.Namespace) -> None:
    """Print the ready line and serve until SIGTERM."""
    termination = Termination()
    if args.recorded and not args.replay:
        args.replay = recording_of(args.recorded)
    table = replayed_table(args.replay, args.replayed) if args.replay else None
    body = CanonBody(still_camera.image_source(args), args.faults, still_camera.body_options(args), table)
    if table is None:
        body.properties.charge(args.battery)
    body.set_by_hand(autofocus=args.lens_switch == "AF", aperture_priority=args.mode_dial == "Av")
    if args.no_card:
        body.take_card_out()
    server = PtpIpServer(args.host, args.port, body.table.model, CanonResponder(body, args.faults), args.faults)
    not_served = [*body.table.not_served, *not_recorded(args)]
    still_camera.serve_until_stopped(server, body, termination, not_served)
